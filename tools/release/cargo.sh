#!/bin/sh
# Runs cargo for another target, with zig as the linker.
#
#   tools/release/cargo.sh TARGET zigbuild|test OPTION...
#
# pip installs zig and cargo-zigbuild into target/release-tools. The standard library of the target
# comes from rustup. Where rustup reaches no server, cargo builds it from the toolchain's component
# rust-src.
set -eu
cd "$(dirname "$0")/../.."
target=$1 command=$2
shift 2

tools=$PWD/target/release-tools
[ -x "$tools/bin/cargo-zigbuild" ] || {
    python3 -m venv "$tools"
    "$tools/bin/pip" install -q cargo-zigbuild==0.24.* ziglang==0.17.*
}
PATH=$tools/bin:$PATH
# Programs without symbols are half as large.
export CARGO_PROFILE_RELEASE_STRIP=symbols

library=$(rustc --print sysroot)/lib/rustlib
if [ -e "$library/$target/lib" ] || rustup target add "$target" 2>/dev/null; then
    exec cargo-zigbuild "$command" --release --target "$target" "$@"
fi
[ -e "$library/src/rust/library/std" ] || {
    echo "error: no standard library for $target: install it with rustup, or the component rust-src" >&2
    exit 1
}
# Building the standard library is a feature of nightly compilers that RUSTC_BOOTSTRAP permits.
RUSTC_BOOTSTRAP=1 RUSTFLAGS="-C link-self-contained=no" \
    exec cargo-zigbuild "$command" --release --target "$target" -Z build-std=std,panic_unwind "$@"
