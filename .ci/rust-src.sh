#!/bin/sh
# Puts the source of the standard library into the toolchain, from Debian's package rust-src of the same
# version, for machines on which rustup reaches no server. tools/release/build.sh uses it.
set -eu
version=$(rustc --version | cut -d' ' -f2)
source=$(rustc --print sysroot)/lib/rustlib/src/rust
[ ! -e "$source/library/std" ] || exit 0
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
mkdir -p "$folder/lists/partial"
# The server that this machine's own packages come from; only the suite differs.
server=$(sed -n 's/^URIs: *//p' /etc/apt/sources.list.d/debian.sources | head -1)
cat >"$folder/backports.sources" <<END
Types: deb
URIs: $server
Suites: trixie-backports
Components: main
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg
END
apt() {
    command="$1"
    shift
    "$command" -o "Dir::Etc::sourcelist=$folder/backports.sources" -o Dir::Etc::sourceparts=/dev/null \
        -o "Dir::State::lists=$folder/lists" -o APT::Sandbox::User=root "$@"
}
apt apt-get update -qq
package=$(apt apt-cache madison rust-src | awk -F'|' -v version="$version" 'index($2, " " version "+") == 1 { gsub(/ /, "", $2); print $2; exit }')
[ -n "$package" ] || { echo "error: Debian has no package rust-src $version" >&2; exit 1; }
(cd "$folder" && apt apt-get download -qq "rust-src=$package")
dpkg-deb -x "$folder"/rust-src_*.deb "$folder/files"
mkdir -p "$source"
cp -r "$folder/files/usr/src/rustc-$version/library" "$source/"
