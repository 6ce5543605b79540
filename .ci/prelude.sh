# What the commands of .ci/sections.toml use. Each section sources it in a shell of its own.
export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
# Packages are kept once, in virtual environments, not in a cache as well: PyTorch's CUDA libraries are 3 GB.
export PIP_NO_CACHE_DIR=1 PIP_QUIET=1
export PATH="$PWD/target/release:$PWD/.venv/bin:$PATH"
# 30 steps of the kernel head spread fireflies; 200 steps suffice to be scored.
quick='s/configs\/quickstart.toml/& --set train.steps=200/'

# Runs a shell block of the documentation, edited by sed expressions that shorten it.
block() {
    local name=$1 commands
    shift
    commands=$(python3 .ci/docs.py show "$name")
    for edit in "$@"; do
        [ "$(sed -e "$edit" <<<"$commands")" != "$commands" ] || { echo "block $name: the edit $edit changes nothing"; exit 1; }
        commands=$(sed -e "$edit" <<<"$commands")
    done
    bash -euxc "$commands"
}

# Installs Debian packages that are missing, as root. Elsewhere they must be there.
install() {
    local missing=()
    command -v apt-get >/dev/null && [ "$(id -u)" = 0 ] || return 0
    for package; do
        dpkg -s "$package" >/dev/null 2>&1 || missing+=("$package")
    done
    [ ${#missing[@]} = 0 ] && return
    apt-get update -qq && apt-get install -y -qq "${missing[@]}" >/dev/null
}
