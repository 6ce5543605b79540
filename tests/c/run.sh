#!/usr/bin/env bash
# Tests the installed C library: run.sh PREFIX [MODEL]
#
# Builds the examples and the tests with the shared and the static library and runs them, then again
# under valgrind. MODEL should be a small model there; without one, "quality" is used.
set -euo pipefail
[ $# -ge 1 ] || { echo "usage: $0 PREFIX [MODEL]" >&2; exit 2; }
root=$(cd "$(dirname "$0")/../.." && pwd)
prefix=$(cd "$1" && pwd)
model=()
[ $# -lt 2 ] || model=("$(realpath "$2")")
export PKG_CONFIG_PATH="$prefix/lib/pkgconfig" LD_LIBRARY_PATH="$prefix/lib"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"

flags=(-O2 -g -Wall -Wextra -Werror -pthread)
for kind in shared static; do
    case $kind in
        shared) read -ra libraries <<<"$(pkg-config --cflags --libs demc) -lm" ;;
        # The linker prefers a shared library, so the archive is named.
        static) read -ra libraries <<<"$(pkg-config --cflags --libs --static demc | sed "s|-ldemc|$prefix/lib/libdemc.a|") -lm" ;;
    esac
    "${CC:-cc}" -std=c99 "${flags[@]}" "$root/bindings/c/examples/denoise.c" -o "c-$kind" "${libraries[@]}"
    "${CXX:-c++}" -std=c++11 "${flags[@]}" "$root/bindings/c/examples/denoise.cpp" -o "cpp-$kind" "${libraries[@]}"
    "${CC:-cc}" -std=c99 "${flags[@]}" "$root"/tests/c/{misuse,use}.c -o "misuse-$kind" "${libraries[@]}"
done
if ldd ./misuse-static | grep demc; then echo "error: the static program needs the shared library"; exit 1; fi

echo "== exported symbols"
others=$(nm -D --defined-only --with-symbol-versions "$prefix/lib/libdemc.so" | awk '{print $3}' | grep -vE '^(demc[A-Za-z]+@@)?DEMC_[0-9.]+$' || true)
[ -z "$others" ] || { echo "error: other symbols: $others"; exit 1; }
exported=$(nm -D --defined-only "$prefix/lib/libdemc.so" | grep -c ' T ')
declared=$(grep -v '^ *//' "$prefix/include/demc.h" | grep -coE 'demc[A-Z][A-Za-z]+\(')
[ "$exported" = "$declared" ] || { echo "error: $exported symbols, but the header has $declared functions"; exit 1; }
echo "$exported functions"

for kind in shared static; do
    echo "== $kind library"
    "./c-$kind" "${model[@]}"
    mv denoised.pfm c.pfm
    "./cpp-$kind" "${model[@]}"
    cmp c.pfm denoised.pfm
    "./misuse-$kind" "${model[@]}"
done
if "./c-shared" no-such.safetensors; then echo "error: a missing model is no error"; exit 1; fi

echo "== valgrind"
# Valgrind knows no AVX-512.
export DEMC_ISA=avx2
grep -qw avx2 /proc/cpuinfo || DEMC_ISA=portable
for program in c-shared cpp-shared misuse-shared; do
    valgrind --quiet --leak-check=full --error-exitcode=1 --suppressions="$root/tests/c/valgrind.supp" \
        "./$program" "${model[@]}"
done
echo "c library: all passed"
