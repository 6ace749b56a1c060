#!/bin/sh
# Install locked Python packages and the application: install-python-packages.sh LOCK VENV [--editable]
#
# Plain pip and the lock's hashes: nothing is resolved here, so everybody gets the same packages.
# Used by the Makefile (editable) and by the image alike. PYTHON names the interpreter of a new venv.
set -eu

root=$(cd "$(dirname "$0")/.." && pwd)
lock=$1
venv=$2
editable=${3:-}
python=${PYTHON:-python3}

if ! "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))'; then
    echo "$python is $("$python" --version 2>&1), but Python 3.11, 3.12 or 3.13 is needed; name one: make PYTHON=python3.12" >&2
    exit 1
fi
if [ ! -x "$venv/bin/python" ] && ! "$python" -m venv "$venv"; then
    echo "$python can't make a virtual environment in $venv; on Debian, install python3-venv." >&2
    exit 1
fi

pip() {
    "$venv/bin/python" -m pip --disable-pip-version-check --no-input "$@"
}

# --no-deps: the lock is complete, and pip needn't look for what it doesn't name.
pip install --quiet --progress-bar off --retries 5 --require-hashes --no-deps -r "$lock"
# Without build isolation, because what builds the package is locked too.
pip install --quiet --no-deps --no-build-isolation ${editable:+"$editable"} "$root"
pip check
