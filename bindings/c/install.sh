#!/usr/bin/env bash
# Builds the C library and installs it: install.sh PREFIX (Linux; needs Rust and a C compiler).
#
#   PREFIX/include/demc.h, demc.hpp
#   PREFIX/lib/libdemc.so.VERSION with its links, libdemc.a
#   PREFIX/lib/pkgconfig/demc.pc
#   PREFIX/share/licenses/demc/
set -euo pipefail
[ $# = 1 ] || { echo "usage: $0 PREFIX" >&2; exit 2; }
mkdir -p "$1"
prefix=$(cd "$1" && pwd)
cd "$(dirname "$0")/../.."
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
soname=libdemc.so.${version%%.*}
# What rustc --print native-static-libs names.
libraries="-lgcc_s -lutil -lrt -lpthread -lm -ldl -lc"

cargo build --release -p demc-c
archive=${CARGO_TARGET_DIR:-target}/release/libdemc.a

mkdir -p "$prefix"/{include,lib/pkgconfig,share/licenses/demc}
install -m 644 bindings/c/include/demc.h bindings/c/include/demc.hpp "$prefix/include"
install -m 644 LICENSE-APACHE LICENSE-MIT "$prefix/share/licenses/demc"
install -m 644 "$archive" "$prefix/lib/libdemc.a"
strip --strip-debug "$prefix/lib/libdemc.a"

# rustc gives its shared libraries no versions of symbols, so the C compiler links it.
"${CC:-cc}" -shared -o "$prefix/lib/libdemc.so.$version" \
    -Wl,--whole-archive "$archive" -Wl,--no-whole-archive $libraries \
    -Wl,--version-script=bindings/c/demc.map -Wl,-soname,"$soname" \
    -Wl,--gc-sections -Wl,-z,relro,-z,now -Wl,--as-needed -Wl,--strip-debug
ln -sf "libdemc.so.$version" "$prefix/lib/$soname"
ln -sf "$soname" "$prefix/lib/libdemc.so"

cat >"$prefix/lib/pkgconfig/demc.pc" <<PC
prefix=$prefix
libdir=\${prefix}/lib
includedir=\${prefix}/include

Name: demc
Description: Denoiser for Monte Carlo renderings
Version: $version
Cflags: -I\${includedir}
Libs: -L\${libdir} -ldemc
Libs.private: $libraries
PC
echo "installed demc $version in $prefix"
