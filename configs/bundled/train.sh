#!/bin/sh
# Trains models like the bundled ones: trains the albedo filter, renders the data, cleans the references,
# for `quality` also the albedo, trains the stages of each model, and exports the weights.
#
#   configs/bundled/train.sh [--base DIR]
#   configs/bundled/train.sh --try          2 steps per stage on data/sample, about 1 minute
#
# --base is the data set that the rendered views are added to, by default data/renders. That set (89
# training and 19 test scenes) is not in the repository; data/sample is a part of it. DIR starts at the
# repository root.
#
# Run it from any directory. It needs demc-train and demc-infer on the PATH. Rendering also needs
# Python with mitsuba, bpy, pyluxcore, numpy, OpenEXR, pyoidn, and torch; PYTHON names the interpreter. Rerun
# the script to resume it: complete data sets and stages are skipped.
set -eu

usage() {
    echo "usage: $0 [--try | --base DIR]" >&2
    exit 2
}

base=data/renders
steps=
while [ $# -gt 0 ]; do
    case $1 in
    --try) steps=2 ;;
    --base)
        [ $# -gt 1 ] || usage
        base=$2
        shift
        ;;
    *) usage ;;
    esac
    shift
done

cd "$(dirname "$0")/../.."
repository=$PWD
python=${PYTHON:-python3}

render_albedo() {
    [ ! -e data/bundled/albedo/manifest.json ] || return 0
    # 85 views of stock renderers, and 86 rooms and still lifes.
    for views in "cycles 101-140" "mitsuba 202-224" "luxcore 302-323"; do
        "$python" tests/renderers/data_set.py $views -o data/bundled/stock --size 192x192 --ref-spp 96
    done
    "$python" tools/render -o data/bundled/rooms --rooms 26 --stills 26 --size 192 --grain 0.8 --sun 0.8 \
        --ref-spp 64 --residual 1 --seed 71
    "$python" configs/bundled/albedo_set.py data/bundled/stock data/bundled/rooms -o data/bundled/albedo
}

render_train() {
    [ -e "$base/manifest.json" ] || {
        echo "error: $base/manifest.json: no such file; --base names another data set" >&2
        exit 1
    }
    "$python" tools/render -o data/bundled/train --preset train --with "$base"
    "$python" tools/references.py --data data/bundled/train -o data/bundled/clean
    "$python" tools/references.py --data data/bundled/train -o data/bundled/filtered --albedo-filter $filter
}

# Trains one stage: train NAME
train() {
    run=runs/bundled/$1
    # The scores of the test split are the last file that a run writes.
    [ ! -e "$run/test.json" ] || return 0
    echo "== $run"
    set -- --config "$repository/configs/bundled/$1.toml"
    [ -z "$steps" ] || set -- "$@" --set "train.steps=$steps"
    [ ! -e "$run" ] || set -- "$@" --resume
    demc-train "$@"
}

filter=runs/bundled/albedo.safetensors
# A trial runs in a directory in which every data set is data/sample.
if [ -n "$steps" ]; then
    rm -rf runs/bundled-try
    mkdir -p runs/bundled-try/data/bundled
    cd runs/bundled-try
    for name in clean filtered albedo; do
        ln -s "$repository/data/sample" "data/bundled/$name"
    done
else
    render_albedo
fi
train albedo
demc-infer export --overwrite --model runs/bundled/albedo -o $filter

[ -n "$steps" ] || render_train
for stage in quality-1 quality-2 quality-3 fast-1 fast-2 fast-3; do
    train $stage
done
demc-infer export --overwrite --model runs/bundled/quality-3 --albedo-filter $filter --precision f16 -o runs/bundled/quality.safetensors
demc-infer export --overwrite --model runs/bundled/fast-3 --precision f16 -o runs/bundled/fast.safetensors
