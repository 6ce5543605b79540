#!/usr/bin/env bash
# Tests this project on a machine with a GPU: parity, speed relative to PyTorch, memory over many steps.
#
#   benches/gpu.sh pack DIR [wgpu,cuda]     on the build machine: makes DIR, which needs no network
#   DIR/benches/gpu.sh run [OPTIONS]        on the GPU machine: writes DIR/benches/results/gpu-NAME.md and .json
#
# The GPU machine needs a driver (Vulkan for wgpu; CUDA with NVRTC for cuda) and a glibc at least as new as that of the
# build machine. With python3, PyTorch and safetensors, PyTorch runs on the same GPU in f32, tf32 and bf16. Without
# PyTorch, the report names it as missing; without python3, it has times of this project only. Nothing is installed.
#
# Options of run:
#   --name NAME         part of the report's file name; default: the name of the GPU
#   --devices "A B"     default "wgpu cuda"; the report names missing devices and leaves them out
#   --cases "A B"       see benches/peers/run.py; default: the paper's network in a training step and at 1280x720
#   --torch-device D    cuda or cpu; default: cuda if nvidia-smi exists
#   --steps N           steps of the memory test; default 500
#   --rounds N          default 5
#   --python P          an interpreter with PyTorch; default python3
#   --small             tiny cases and 20 steps, for a trial on Mesa's software Vulkan
set -euo pipefail
ROOT=$(cd "$(dirname "$0")/.." && pwd)
PEER=$ROOT/target/release/peer
PARITY=$ROOT/target/release/parity
PARTS=10  # measurements of the memory test

fail() { echo "error: $*" >&2; exit 1; }

# DIR mirrors the layout of the repository, so that the scripts find each other.
pack() {
    local to=$1 features=${2-wgpu,cuda} built
    cd "$ROOT"
    cargo build --release -p demc-bench --features "$features"
    built=$(cargo test --release -p demc-tests --features "$features" --test suite --no-run --message-format=json |
        grep -o '"executable":"[^"]*/suite-[^"]*"' | tail -1 | cut -d'"' -f4)
    [ -x "$built" ] || fail "the parity test was not built"
    mkdir -p "$to"/{benches/results,bindings/python,target/release,tests/parity}
    cp -r benches/gpu.sh benches/peers "$to/benches/"
    cp -r bindings/python/demc "$to/bindings/python/"
    cp -r tests/parity/fixtures "$to/tests/parity/"
    cp "${CARGO_TARGET_DIR:-target}/release/peer" "$to/target/release/peer"
    cp "$built" "$to/target/release/parity"
    echo "packed: $(du -sh "$to" | cut -f1) in $to"
}

# Writes the case WIDTH SIZE... for direct use of `peer`.
make_case() { "$PEER" make --width "$1" --size "${@:2}" --weights "$WORK/weights" --inputs "$WORK/inputs"; }

files() { printf -- '--weights\n%s\n--inputs\n%s\n' "$WORK/weights" "$WORK/inputs"; }

# The reason why a device cannot be used, or nothing.
trouble() { { "$PEER" infer $(files) --device "$1" </dev/null >/dev/null || true; } 2>&1 | grep -a '^error' | tail -1 || true; }

# Records a failure in a file, because the report runs in a pipe, which loses variables.
bad() { touch "$WORK/bad"; }

parity() {
    local log=$WORK/parity.log
    echo; echo "### Parity with the PyTorch fixtures"; echo
    if DEMC_DEVICE=$1 DEMC_FIXTURES=$ROOT/tests/parity/fixtures "$PARITY" parity:: >"$log" 2>&1; then
        grep '^test result' "$log"
    else
        bad
        echo '```'; { grep -E '^test .*FAILED|panicked|^test result|^error' "$log" || tail -5 "$log"; } | head -40; echo '```'
    fi
}

speed() {
    local device=$1 command=(--device "$1" --torch-device "$TORCH_DEVICE" --rounds "$ROUNDS" --only PyTorch)
    echo; echo "### Speed"; echo
    if ! command -v "$PYTHON" >/dev/null; then
        echo "$PYTHON is missing: this project alone, after 3 warm-up steps."
        make_case 64 4 128 128
        printf 'step 3\nstep 10\nmemory\n' | "$PEER" train $(files) --lr 1e-4 --device "$device" | sed 's/^/    /' || bad
        make_case 64 1 736 1280
        printf 'step 3\nstep 10\nmemory\n' | "$PEER" infer $(files) --device "$device" | sed 's/^/    /' || bad
        return
    fi
    "$PYTHON" "$ROOT/benches/peers/run.py" "${command[@]}" --cases $CASES --out "${REPORT%.md}-$device.json" || bad
}

# Prints GPU memory and the resident set of the process after each part of the steps.
memory() {
    local device=$1 part=$((STEPS / PARTS)) answer pid i
    echo; echo "### Memory over $STEPS training steps (width $WIDTH, batch $BATCH)"; echo
    echo "| step | GPU MiB used, all processes | host MiB | ms per step |"
    echo "|---:|---:|---:|---:|"
    make_case "$WIDTH" $BATCH
    coproc TRAINING { exec "$PEER" train $(files) --lr 1e-4 --device "$device"; }
    pid=$TRAINING_PID
    read -r _ <&"${TRAINING[0]}" || { bad; return; }
    for ((i = 1; i <= PARTS; i++)); do
        echo "step $part" >&"${TRAINING[1]}"
        read -r answer <&"${TRAINING[0]}" || { echo; echo "The process ended after step $(((i - 1) * part))."; bad; return; }
        echo "| $((i * part)) | $(gpu_memory) | $(awk '/VmRSS/ {printf "%d", $2 / 1024}' "/proc/$pid/status") |" \
            "$(awk -F'[:}]' '{printf "%.1f", 1000 * $2}' <<<"$answer") |"
    done
    eval "exec ${TRAINING[1]}>&-"
    wait "$pid" || bad
}

gpu_memory() {
    nvidia-smi --query-gpu=memory.used --format=csv,noheader,nounits 2>/dev/null | paste -sd+ | grep . || echo -
}

machine() {
    local gpu
    gpu=$(nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader 2>/dev/null || true)
    echo "- date: $(date +%F)"
    echo "- GPU: ${gpu:-no nvidia-smi}"
    command -v vulkaninfo >/dev/null && vulkaninfo --summary 2>/dev/null | grep -E 'deviceName|driverInfo' | sed 's/^\s*/- /'
    echo "- CPU: $(awk -F': ' '/model name/ {print $2; exit}' /proc/cpuinfo), $(nproc) cores"
    echo "- $("$PEER" --version)"
}

run() {
    local name="" devices="wgpu cuda"
    CASES="train-4x128x128-c64 train-16x128x128-c64 infer-1280x736-c64" STEPS=500 ROUNDS=5 PYTHON=python3
    WIDTH=64 BATCH="4 128 128" TORCH_DEVICE=cpu
    command -v nvidia-smi >/dev/null && TORCH_DEVICE=cuda
    while [ $# -gt 0 ]; do
        case $1 in
            --name) name=$2; shift ;;
            --devices) devices=$2; shift ;;
            --cases) CASES=$2; shift ;;
            --torch-device) TORCH_DEVICE=$2; shift ;;
            --steps) STEPS=$2; shift ;;
            --rounds) ROUNDS=$2; shift ;;
            --python) PYTHON=$2; shift ;;
            --small) CASES="train-2x64x64-c4 infer-96x64-c4" STEPS=20 ROUNDS=2 WIDTH=4 BATCH="1 32 32" ;;
            *) fail "unknown option $1" ;;
        esac
        shift
    done
    [ -x "$PEER" ] && [ -x "$PARITY" ] || fail "not built: run \`$0 pack DIR\`, then DIR/benches/gpu.sh"
    if [ -z "$name" ]; then
        name=$(nvidia-smi --query-gpu=name --format=csv,noheader 2>/dev/null | head -1 | tr -cs 'A-Za-z0-9\n' - || true)
    fi
    mkdir -p "$ROOT/benches/results"
    REPORT=$ROOT/benches/results/gpu-${name:-unknown}.md
    WORK=$(mktemp -d)
    trap 'rm -rf "$WORK"' EXIT
    {
        echo "# demc on ${name:-an unknown GPU}"; echo
        machine
        for device in $devices; do
            echo; echo "## $device"
            make_case 2 1 32 32
            why=$(trouble "$device")
            if [ -n "$why" ]; then
                echo; echo "Left out: $why"
                continue
            fi
            parity "$device"
            speed "$device"
            memory "$device"
        done
    } | tee "$REPORT"
    echo "written: $REPORT" >&2
    if [ -e "$WORK/bad" ]; then fail "something failed: see the report"; fi
}

case ${1:-} in
    pack) [ $# -ge 2 ] || fail "pack needs a directory"; pack "${@:2}" ;;
    run) run "${@:2}" ;;
    *) sed -n '2,/^set -e/p' "$0" | sed '$d; s/^# \{0,1\}//'; exit 2 ;;
esac
