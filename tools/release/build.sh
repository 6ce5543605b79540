#!/bin/sh
# Builds archives with static programs for Linux: no Rust, no shared library, any distribution.
#
#   tools/release/build.sh [--programs "demc-infer ..."] [TARGET...]
#
# TARGET is x86_64-unknown-linux-musl or aarch64-unknown-linux-musl, by default both. The archives and
# their SHA256SUMS are written to dist/. Each archive has the programs, manual pages, completions for
# bash, zsh, and fish, and the licences of all crates.
#
# It needs cargo and Python 3.11; tools/release/cargo.sh says how it links and where a standard library comes from.
set -eu

programs="demc-infer demc-train demc-data"
if [ "${1-}" = --programs ]; then
    programs=$2
    shift 2
fi
[ $# -gt 0 ] || set -- x86_64-unknown-linux-musl aarch64-unknown-linux-musl

cd "$(dirname "$0")/../.."
export CARGO_INCREMENTAL=0
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
mkdir -p dist
documents=$PWD/target/release-documents
rm -rf "$documents"
mkdir -p "$documents"
python3 tools/release/licences.py >"$documents/LICENCES-OF-CRATES.txt"
# The description of the command line is the same for all targets.
cargo run --release -q -p demc-train --example manuals -- "$documents"

packages=
for program in $programs; do
    packages="$packages -p $program"
done
for target; do
    # shellcheck disable=SC2086
    tools/release/cargo.sh "$target" zigbuild $packages
    name=demc-$version-$target
    folder=$PWD/target/release-archive/$name
    rm -rf "$folder"
    mkdir -p "$folder"
    for program in $programs; do
        cp "target/$target/release/$program" "$folder/"
    done
    cp -r "$documents/man" "$documents/completions" "$documents/LICENCES-OF-CRATES.txt" "$folder/"
    cp LICENSE-MIT LICENSE-APACHE models/README.md "$folder/"
    mv "$folder/README.md" "$folder/MODEL.md"
    tar --sort=name --owner=0 --group=0 --numeric-owner --mtime=@0 -C "$folder/.." -cf - "$name" |
        gzip -9n >"dist/$name.tar.gz"
done
(cd dist && sha256sum demc-"$version"-*.tar.gz >SHA256SUMS && cat SHA256SUMS)
