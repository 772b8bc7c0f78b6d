#!/bin/sh
# Are the system libraries there that Open3D needs? Root on Debian or Ubuntu: installs what is
# missing. Anybody else: names the packages, and exits with 1.
# usage: scripts/system_packages.sh VENV
#
# The list comes from the installed Open3D itself: what `ldd` cannot find for its compiled module.
set -eu

venv=$1
: "${LDD:=ldd}"

[ "$(uname -s)" = Linux ] || exit 0
command -v "$LDD" >/dev/null || exit 0

module=
for file in "$venv"/lib/python3*/site-packages/open3d/pybind*.so \
  "$venv"/lib/python3*/site-packages/open3d/cpu/pybind*.so; do
  [ -e "$file" ] && module=$file && break
done
if [ -z "$module" ]; then
  echo "system packages: Open3D is not installed in $venv (make clean, then try again)" >&2
  exit 1
fi

missing_libraries() {
  "$LDD" "$module" 2>/dev/null | awk '/=> not found/ { print $1 }' | sort -u
}

# The names are the same on Debian 12 and 13 and on Ubuntu 22.04 and 24.04.
package_of() {
  case $1 in
    libEGL.so.1) echo libegl1 ;;
    libGL.so.1) echo libgl1 ;;
    libGLX.so.0) echo libglx0 ;;
    libGLdispatch.so.0) echo libglvnd0 ;;
    libX11.so.6) echo libx11-6 ;;
    libxcb.so.1) echo libxcb1 ;;
    libgomp.so.1) echo libgomp1 ;;
    libidn2.so.0) echo libidn2-0 ;;
    libudev.so.1) echo libudev1 ;;
    libusb-1.0.so.0) echo libusb-1.0-0 ;;
    libstdc++.so.6) echo libstdc++6 ;;
    libgcc_s.so.1) echo libgcc-s1 ;;
  esac
}

missing=$(missing_libraries)
[ -n "$missing" ] || exit 0

packages=
for library in $missing; do
  packages="$packages $(package_of "$library")"
done
packages=$(echo $packages) # one blank between names, none around

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null && [ -n "$packages" ]; then
  echo "system packages: installing $packages (Open3D needs them)"
  # $packages unquoted on purpose: one argument for each. A package list that cannot be refreshed is
  # no reason to stop: apt may know the packages already.
  apt_says=$({
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $packages
  } 2>&1) || printf '%s\n' "$apt_says" | grep '^E: ' >&2 || true
  missing=$(missing_libraries)
  [ -n "$missing" ] || exit 0
fi

echo "system packages: Open3D cannot load; this system lacks" $missing >&2
if [ -n "$packages" ]; then
  echo "system packages: on Debian or Ubuntu run: sudo apt-get update && sudo apt-get install $packages" >&2
else
  echo "system packages: install them with your system's package manager" >&2
fi
exit 1
