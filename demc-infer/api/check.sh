#!/bin/sh
# Compares the public API of demc-infer with api.txt: check.sh [--write]
#
# rustdoc writes the API as JSON, which stable compilers do only with RUSTC_BOOTSTRAP. A wrapper sets it
# for rustdoc alone: build scripts of dependencies would otherwise run again.
set -eu
cd "$(dirname "$0")/../.."
wrapper=$(mktemp)
trap 'rm -f "$wrapper"' EXIT
printf '#!/bin/sh\nRUSTC_BOOTSTRAP=1 exec rustdoc "$@"\n' >"$wrapper"
chmod +x "$wrapper"
# The features of `cargo doc` in CI, so that nothing is compiled twice. CubeCL needs no LLVM for this.
export DOCS_RS=1
RUSTDOC=$wrapper RUSTDOCFLAGS="-Z unstable-options --output-format json" \
    cargo doc --workspace --no-deps --all-features --quiet
cargo run --release --quiet --manifest-path demc-infer/api/Cargo.toml --target-dir target/api -- target/doc/demc_infer.json "$@"
