#!/bin/sh
# Install the Debian packages of the named lists: install-system-packages.sh run [test]
#
# The lists stand beside this script as packages-NAME.txt. What is there already isn't touched, so
# neither root nor the network is needed then. Used by the Makefile and by the image alike.
set -eu

here=$(cd "$(dirname "$0")" && pwd)

wanted() {
    for name in "$@"; do
        list="$here/packages-$name.txt"
        if [ ! -f "$list" ]; then
            echo "There is no package list $list; the lists are run and test." >&2
            exit 2
        fi
        sed -e 's/#.*//' -e '/^[[:space:]]*$/d' "$list"
    done
}

is_installed() {
    [ "$(dpkg-query --show --showformat='${db:Status-Status}' "$1" 2>/dev/null)" = installed ]
}

packages=$(wanted "$@")

if ! command -v dpkg-query >/dev/null; then
    echo "This is no Debian: make sure that you have what these packages hold:" $packages
    exit 0
fi

missing=""
for package in $packages; do
    is_installed "$package" || missing="$missing $package"
done
[ -n "$missing" ] || exit 0

if [ "$(id -u)" -eq 0 ]; then
    as_root=""
elif command -v sudo >/dev/null; then
    as_root="sudo"
else
    echo "These Debian packages are missing:$missing. Install them as root: apt-get install$missing" >&2
    exit 1
fi

echo "Installing Debian packages:$missing"
# `env` because sudo drops the environment; three tries because mirrors have bad moments.
$as_root env DEBIAN_FRONTEND=noninteractive apt-get -q -o Acquire::Retries=3 update
# shellcheck disable=SC2086  # the list is meant to be split
$as_root env DEBIAN_FRONTEND=noninteractive \
    apt-get -q -y -o Acquire::Retries=3 install --no-install-recommends $missing
