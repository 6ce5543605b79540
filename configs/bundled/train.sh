#!/bin/sh
# Trains models like the bundled ones: renders the data, runs the 13 stages of `quality`, trains the albedo
# filter and then `fast`, exports the weights.
#
#   configs/bundled/train.sh [--base DIR]   10 hours of training and 7 hours of rendering on 2 cores
#   configs/bundled/train.sh --try          2 steps per stage on data/sample, about 1 minute
#
# --base is the data set that the rendered views are added to, by default data/renders. That set (89
# training and 19 test scenes) is not in the repository; data/sample is a part of it. DIR starts at the
# repository root.
#
# Run it from any directory. It needs demc-train and demc-infer on the PATH. Rendering also needs
# Python with mitsuba, bpy, pyluxcore, numpy, OpenEXR, pyoidn, safetensors, and torch; PYTHON names the
# interpreter. Rerun the script to resume it: complete data sets and stages are skipped.
#
# The results resemble the bundled models but have other weights. `fast` was trained on the first 583 of the
# about 1,550 views that its data set keeps. About `quality`:
# - The original stages 1 to 8 filtered the references during training (data.reference_filter).
#   Here references.py cleans them.
# - The original runs set train.lr_fan_in = 96 and train.recycle = 1000. Both keys are removed.
# - The original references of stages 9 to 11 were cleaned with guides that were not denoised.
# - Stages 9 and 12 started from a half-precision export of the stage before.
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

# Renders views and lists them together with the scenes of another data set:
# render NAME OTHER_DATA OPTION...
render() {
    name=$1 other=$2
    shift 2
    [ -e "data/bundled/$name/complete" ] && return
    echo "== rendering data/bundled/$name"
    "$python" python/render -o "data/bundled/$name" --with "$other" "$@"
    touch "data/bundled/$name/complete"
}

# Renders views of stock renderers: stock NAME RENDERER SCENES OPTION...
stock() {
    name=$1 renderer=$2 scenes=$3
    shift 3
    "$python" tests/renderers/data_set.py "$renderer" "$scenes" -o "data/bundled/$name" "$@"
}

# Denoises the references of a data set: clean NAME RENDERED OPTION...
clean() {
    name=$1 rendered=$2
    shift 2
    [ -e "data/bundled/$name/complete" ] && return
    echo "== cleaning the references of data/bundled/$rendered"
    "$python" python/tools/references.py --data "data/bundled/$rendered" -o "data/bundled/$name" "$@"
    touch "data/bundled/$name/complete"
}

render_all() {
    [ -e "$base/manifest.json" ] || {
        echo "error: $base/manifest.json: no such file; --base names another data set" >&2
        exit 1
    }
    set_of() { echo "data/bundled/$1"; }

    # Stages 1 to 8: 836 views of rooms and 337 of still lifes.
    render a1 "$base" --rooms 145 --grain 0 --black 0 --sun 0 --seed 2
    render a2 "$(set_of a1)" --rooms 107 --grain 0 --black 0 --sun 1 --seed 3
    render a3 "$(set_of a2)" --rooms 31 --grain 0 --black 0 --sun 1 --seed 4
    render a4 "$(set_of a3)" --rooms 129 --grain 0.8 --black 0 --sun 0.8 --seed 5
    render a5 "$(set_of a4)" --rooms 220 --grain 0.6 --black 0.7 --sun 1 --seed 6
    render a6 "$(set_of a5)" --stills 170 --studio 0 --seed 7
    clean clean-a a6

    # Stages 9 to 11: 739 other views, with albedo and normals of the reference's samples.
    render b1 "$base" --rooms 110 --black 0.6 --sun 1 --seed 21 --ref-spp 96
    render b2 "$(set_of b1)" --stills 60 --studio 0 --seed 22 --ref-spp 96
    render b3 "$(set_of b2)" --rooms 100 --black 0.3 --sun 0.8 --seed 23 --ref-spp 96
    render b4 "$(set_of b3)" --stills 36 --studio 1 --seed 24 --ref-spp 96
    render b5 "$(set_of b4)" --rooms 204 --black 0.6 --sun 1 --seed 31 --ref-spp 96
    clean clean-b b5

    # Stage 12: the same and 506 more views.
    render c1 "$(set_of b5)" --rooms 200 --stills 130 --black 0.5 --sun 1 --seed 51 --ref-spp 96
    clean clean-c c1

    # Stage 13: the base set and 30 views of stock renderers, each listed four times.
    if [ ! -e data/bundled/clean-d/complete ]; then
        set -- --with "$base" --copies 4 --size 192x192 --ref-spp 96
        stock d cycles 101-117 "$@"
        stock d mitsuba 202-208 "$@"
        stock d luxcore 302-307 "$@"
        clean clean-d d
    fi

    # Albedo filter: those 30 views, 55 others, and 86 rooms and still lifes.
    [ ! -e data/bundled/albedo/manifest.json ] || return 0
    stock e cycles 118-140 --size 224x224 --ref-spp 64
    stock e mitsuba 209-224 --size 224x224 --ref-spp 64
    stock e luxcore 308-323 --size 224x224 --ref-spp 64
    render e1 data/bundled/e --rooms 26 --stills 26 --size 192 --grain 0.8 --sun 0.8 --ref-spp 64 --residual 1 --seed 71
    "$python" configs/bundled/albedo_set.py data/bundled/d data/bundled/e data/bundled/e1 -o data/bundled/albedo
}

# A trial runs in a directory in which every data set is data/sample.
if [ -n "$steps" ]; then
    rm -rf runs/bundled-try
    mkdir -p runs/bundled-try/data/bundled
    cd runs/bundled-try
    for name in clean-a clean-b clean-c clean-d clean-f albedo; do
        ln -s "$repository/data/sample" "data/bundled/$name"
    done
else
    render_all
fi

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

for stage in 01 02 03 04 05 06 07 08 09 10 11 12 13 albedo; do
    train $stage
done

# The data of `fast`: views with 1 to 256 samples per pixel, whose albedo is filtered as in denoising.
filter=runs/bundled/albedo.safetensors
demc-infer export --model runs/bundled/albedo -o $filter
if [ -z "$steps" ]; then
    render f "$base" --preset train
    clean clean-f f --albedo-filter $filter
fi
train fast

[ -z "$steps" ] || exit 0
# `quality` is 0.7 of stage 13 and 0.3 of stage 12.
for stage in 12 13; do
    demc-infer export --model "runs/bundled/$stage" -o "runs/bundled/$stage.safetensors"
done
"$python" configs/bundled/average.py runs/bundled/12.safetensors runs/bundled/13.safetensors 0.7 runs/bundled/mean.safetensors
demc-infer export --model runs/bundled/mean.safetensors --albedo-filter $filter --precision f16 -o runs/bundled/quality.safetensors
demc-infer export --model runs/bundled/fast --albedo-filter $filter --precision f16 -o runs/bundled/fast.safetensors
