#!/bin/sh
# SPDX-License-Identifier: MIT
# Installs graspd as a service, brings it up to date, or removes it (deploy/README.md).
set -eu
umask 022
export LC_ALL=C

usage() {
    cat <<'END'
usage: deploy/install.sh [--prefix DIR] [--wheelhouse DIR] [--extras LIST] [--python PROGRAM]
                         [--can] [--rebuild] [--enable NAME] [--root DIR]
       deploy/install.sh --uninstall [--purge] [--prefix DIR] [--root DIR]

Run it again to bring an installation up to date; where there is nothing to do it says so.

  --prefix DIR      where the virtual environment goes (/opt/graspd, or where it is already); only
                    root may write there and in the folders above it
  --wheelhouse DIR  install from the wheels in DIR and from nowhere else; graspd's own must be among
                    them. On a computer with network and the same Python: pip wheel -w DIR .
                    (with extras: pip wheel -w DIR '.[record]')
  --extras LIST     optional parts of graspd, such as record (those that are there already; none: -)
  --python PROGRAM  the Python to use, 3.11 or newer (python3); not one below /home or /root, which
                    the service cannot see (with --root a warning if it is named)
  --can             also have systemd-networkd bring up can0; an update keeps it
  --rebuild         make the virtual environment again, even if graspd has not changed
  --enable NAME     start graspd@NAME now and at boot, with the scene /etc/graspd/NAME.toml; where
                    systemd does not run, as in a chroot or the build of an image, at boot
  --root DIR        put all files below DIR as if it were /, for a package or an image:
                    no user is made and no service touched
  --uninstall       stop all hands and remove what was installed, but not the scenes in /etc/graspd
                    and not what the hands have learned in /var/lib/graspd
  --purge           with --uninstall: remove those, recordings and the user graspd too

Exit codes: 0 done; 1 failed, and what was installed before still works; 2 wrong command line.
With --uninstall 1 means that something is left, which the message names.
END
}

say() { printf 'graspd: %s\n' "$*"; }
fail() { say "$*" >&2; exit 1; }
wrong() { say "$*" >&2; say "see $0 --help" >&2; exit 2; }

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
source=$(dirname -- "$here")
units=/usr/local/lib/systemd/system
command_link=/usr/local/bin/graspd
network_file=/usr/local/lib/systemd/network/80-graspd-can.network

prefix='' root='' wheelhouse='' extras='' python='' enable=''
can='' rebuild='' uninstall='' purge=''
live='' # systemd runs here
changed=''
new='' # the environment that is being made; gone unless it is complete
scratch=''

main() {
    arguments "$@"
    trap 'rm -rf -- "$new" "$scratch"' EXIT
    trap 'exit 130' INT
    trap 'exit 143' TERM
    scratch=$(mktemp -d)
    [ -z "$root" ] || find_root
    find_prefix
    find_extras
    check_host
    if [ -n "$uninstall" ]; then remove; else install_all; fi
}

arguments() {
    while [ $# -gt 0 ]; do
        option=$1
        shift
        case $option in
            --prefix | --root | --wheelhouse | --extras | --python | --enable)
                [ -n "${1:-}" ] || wrong "$option needs a value"
                ;;
        esac
        case $option in
            --prefix) prefix=$1; shift ;;
            --root) root=$1; shift ;;
            --wheelhouse) wheelhouse=$1; shift ;;
            --extras) extras=$1; shift ;;
            --python) python=$1; shift ;;
            --enable) enable=$1; shift ;;
            --can) can=1 ;;
            --rebuild) rebuild=1 ;;
            --uninstall) uninstall=1 ;;
            --purge) purge=1 ;;
            -h | --help) usage; exit 0 ;;
            *) wrong "unknown argument $option" ;;
        esac
    done
    check_arguments
}

check_arguments() {
    # These go into shebangs, the unit and sed.
    case $prefix in
        *[!A-Za-z0-9/._-]*) wrong "--prefix: only letters, digits and / . _ -" ;;
        '' | /[!/] | /[!/]*[!/]) ;;
        *) wrong "--prefix must be a folder such as /opt/graspd, without a slash at its end" ;;
    esac
    case $extras in *[!A-Za-z0-9,_-]*) wrong "--extras: names with commas between" ;; esac
    case $enable in *[!a-z0-9_-]*) wrong "--enable: the name of a scene, of a-z 0-9 _ -" ;; esac
    [ -z "$purge" ] || [ -n "$uninstall" ] || wrong "--purge goes with --uninstall"
    [ -z "$uninstall" ] || [ -z "$wheelhouse$extras$python$can$rebuild" ] ||
        wrong "--uninstall goes with --purge, --prefix and --root alone"
    [ -z "$enable" ] || [ -z "$root$uninstall" ] || wrong "--enable: not with --root or --uninstall"
}

find_root() {
    [ -n "$uninstall" ] || mkdir -p -- "$root"
    root=$(cd -- "$root" && pwd -P) || fail "there is no folder $root"
    case $root in
        /) wrong "--root is for another folder than /" ;;
        *[!A-Za-z0-9/._-]*) wrong "--root: only letters, digits and / . _ -" ;;
    esac
}

# Sets prefix to that of --prefix, else where graspd is installed, else /opt/graspd.
find_prefix() {
    there=''
    if [ -L "$root$command_link" ]; then
        there=$(readlink -- "$root$command_link")
        case $there in
            /*/venv/bin/graspd) there=${there%/venv/bin/graspd} ;;
            *) fail "$command_link leads to $there and was not made here; move it away first" ;;
        esac
    elif [ -e "$root$command_link" ]; then
        fail "$command_link is there and was not made here; move it away first"
    fi
    if [ -n "$there" ] && [ -n "$prefix" ] && [ "$there" != "$prefix" ]; then
        fail "graspd is installed in $there; uninstall that first"
    fi
    prefix=${prefix:-${there:-/opt/graspd}}
    if [ -e "$root$prefix/venv" ] && [ ! -L "$root$prefix/venv" ]; then
        fail "$prefix/venv is there and was not made here; choose another --prefix"
    fi
}

# Fails if others than root (with --root: or its caller) may write at the prefix or above it, for
# root runs what is there.
check_prefix() {
    resolved=$(realpath -m -- "$root$prefix")
    case $resolved in
        "$root"/*) ;;
        *) fail "$prefix leads out of $root" ;;
    esac
    for way in "$root$prefix" "$resolved"; do
        case ${way#"$root"}/ in
            /home/* | /root/* | /run/* | /tmp/* | /var/tmp/*)
                fail "the service cannot see ${way#"$root"} (ProtectHome, PrivateTmp)"
                ;;
            /dev/* | /proc/* | /sys/*) fail "${way#"$root"} is on no disk" ;;
        esac
        while [ "$way" != "$root" ]; do
            check_folder "${way:-/}"
            way=${way%/*}
        done
    done
    [ -n "$root" ] || check_folder /
}

check_folder() {
    status=$(stat -Lc '%u %a' -- "$1" 2>/dev/null) || return 0 # it will be made
    case ${status% *} in
        0 | "$(id -u)") ;;
        *) fail "${1#"$root"}, on the way to $prefix, is not root's; choose another --prefix" ;;
    esac
    case $status in
        *[2367] | *[2367]?)
            fail "others may write ${1#"$root"}, on the way to $prefix (mode ${status#* })" ;;
    esac
}

# Sets extras to --extras, else those installed: an update must not take the recorder away.
find_extras() {
    case $extras in
        -) extras='' ;;
        '') extras=$(cat "$root$prefix/venv/extras" 2>/dev/null || true) ;;
    esac
}

check_host() {
    if [ -z "$root" ]; then
        [ "$(id -u)" = 0 ] || fail "must run as root: sudo $0"
        [ ! -d /run/systemd/system ] || live=1
    fi
    [ -z "$uninstall" ] || return 0
    [ -n "$root" ] || command -v systemd-sysusers >/dev/null ||
        fail "there is no systemd-sysusers: apt install systemd"
    check_prefix
    asked_python=$python
    python=${python:-python3}
    command -v "$python" >/dev/null || fail "there is no $python"
    "$python" -I -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        fail "$python is $("$python" --version 2>&1); graspd needs Python 3.11 or newer (--python)"
    "$python" -I -c 'import ensurepip, venv' 2>/dev/null ||
        fail "$python has no venv: apt install python3-venv"
    case $("$python" -I -c 'import sys; print(sys.base_prefix)')/ in
        /home/* | /root/*)
            hidden="the service cannot see $python (ProtectHome); choose another, such as"
            hidden="$hidden --python /usr/bin/python3"
            # A build may have its reasons, but has to name such a Python itself.
            if [ -z "$root" ] || [ -z "$asked_python" ]; then fail "$hidden"; fi
            say "warning: $hidden" >&2
            ;;
    esac
    check_extras
    [ -z "$wheelhouse" ] || check_wheelhouse
}

# Fails for a part that graspd does not have, of which pip only warns; with wheels alone, without
# the source, that warning has to do.
check_extras() {
    [ -f "$source/pyproject.toml" ] || return 0
    "$python" -I - "$source/pyproject.toml" >"$scratch/extras" <<'END'
import sys, tomllib
with open(sys.argv[1], "rb") as file:
    print(" ".join(tomllib.load(file)["project"]["optional-dependencies"]))
END
    known=$(cat "$scratch/extras")
    for extra in $(printf '%s' "$extras" | tr , ' '); do
        case " $known " in
            *" $extra "*) ;;
            *) wrong "--extras: graspd has no part $extra; it has: $known" ;;
        esac
    done
}

check_wheelhouse() {
    [ -d "$wheelhouse" ] || fail "$wheelhouse is not a folder"
    wheelhouse=$(cd -- "$wheelhouse" && pwd)
    set -- "$wheelhouse"/graspd-*.whl
    [ -f "$1" ] || fail "$wheelhouse has no wheel of graspd: pip wheel -w $wheelhouse $source"
    # pip would take the highest, even if a lower one was added to go back to it.
    [ $# = 1 ] || fail "$wheelhouse has several wheels of graspd: leave the one to install"
}

install_all() {
    environment
    link
    each_file put
    backoff
    network
    example
    [ -n "$root" ] || activate
    sweep
    if [ -n "$changed" ]; then
        say "installed in $prefix"
    else
        say "nothing to change in $prefix"
    fi
    [ -z "$live" ] || advise
    [ -z "$enable" ] || start
    [ -n "$root$live" ] || say "systemd does not run here: no service is reloaded or started"
}

each_file() {
    "$1" systemd/graspd@.service "$units/graspd@.service"
    "$1" sysusers.d/graspd.conf /usr/local/lib/sysusers.d/graspd.conf
    "$1" tmpfiles.d/graspd.conf /usr/local/lib/tmpfiles.d/graspd.conf
    "$1" udev/70-graspd.rules /usr/local/lib/udev/rules.d/70-graspd.rules
    "$1" shell/graspd.1 /usr/local/share/man/man1/graspd.1
}

did() {
    say "$*"
    changed="$changed $*"
}

# put FILE DESTINATION: copies a file that differs, with the prefix in place of /opt/graspd.
put() {
    sed "s|/opt/graspd|$prefix|g" "$here/$1" >"$scratch/file"
    if cmp -s "$scratch/file" "$root$2"; then return; fi
    install -D -m 644 -- "$scratch/file" "$root$2"
    did "wrote $2"
}

# The environment is made beside the former one, where it will stay, and the link to it is exchanged
# when it works.
environment() {
    inputs >"$scratch/inputs"
    digest=$(sha256sum <"$scratch/inputs")
    current=$root$prefix/venv
    if [ -z "$rebuild" ] && [ "$(cat "$current/inputs.sha256" 2>/dev/null)" = "$digest" ] &&
        "$current/bin/python" -I -m graspd --version >/dev/null 2>&1; then
        return
    fi
    say "making a virtual environment in $prefix"
    mkdir -p -- "$root$prefix"
    new=$(mktemp -d "$root$prefix/venv-XXXXXX")
    chmod 755 "$new"
    "$python" -I -m venv "$new" || fail "no virtual environment; nothing has changed"
    packages || fail "pip failed; nothing has changed"
    version=$(version_of "$new") ||
        fail "the new graspd does not start; nothing has changed"
    former=$(version_of "$current" 2>/dev/null || true)
    settle
    printf '%s\n' "$digest" >"$new/inputs.sha256"
    printf '%s\n' "$extras" >"$new/extras"
    ln -sfn "${new##*/}" "$root$prefix/venv.new"
    new='' # an interruption during the next line must not remove what it makes current
    mv -T "$root$prefix/venv.new" "$current"
    case $former in
        '') did "$prefix/venv is new: $version" ;;
        "$version") did "$prefix/venv is new: $version again, rebuilt" ;;
        *) did "$prefix/venv is new: from $former to $version" ;;
    esac
}

# Prints the first line of graspd --version, such as "graspd 0.1.0"; fails if it does not start.
version_of() {
    "$1/bin/python" -I -m graspd --version >"$scratch/version" || return 1
    sed -n 1p "$scratch/version"
}

# Prints all that the environment is made of: while this is the same, so is the environment.
inputs() {
    "$python" -I -c 'import sys; print(sys.executable, sys.version)'
    printf '%s\n' "$extras"
    if [ -n "$wheelhouse" ]; then
        (cd -- "$wheelhouse" && sha256sum -- *.whl)
    else
        (cd -- "$source" && find pyproject.toml README.md LICENSE daemon drivers models \
            deploy/package deploy/clients/python deploy/scenes deploy/shell \
            -type f ! -path '*/__pycache__/*' -exec sha256sum {} +) >"$scratch/sources"
        sort -k 2 "$scratch/sources"
    fi
}

packages() {
    set -- --quiet --no-compile --disable-pip-version-check
    if [ -n "$wheelhouse" ]; then
        set -- "$@" --isolated --no-index --only-binary :all: --find-links "$wheelhouse" \
            "graspd${extras:+[$extras]}"
    else
        set -- "$@" "$source${extras:+[$extras]}"
    fi
    "$new/bin/python" -I -m pip install "$@"
}

# Below --root, programs and byte code must name the place where they will be.
settle() {
    if [ -n "$root" ]; then
        grep -rlIF -- "$root" "$new/bin" "$new/pyvenv.cfg" | while IFS= read -r file; do
            sed -i "s|$root/|/|g" "$file"
        done
        set -- -f -s "$root" -p /
    else
        # What graspd never imports, a third, stays as it is.
        set -- -x '/site-packages/((pip|setuptools|pkg_resources)|.*/tests)/'
    fi
    # A module that does not compile is one that is never used: pip does not mind either.
    "$new/bin/python" -I -m compileall -qq -j 0 "$@" "$new/lib" || true
}

# Removes former environments, except those that a running graspd still uses.
sweep() {
    current=$(readlink -- "$root$prefix/venv")
    for former in "$root$prefix"/venv-*; do
        if [ ! -d "$former" ] || [ "${former##*/}" = "$current" ]; then continue; fi
        if used "$former"; then
            say "kept ${former#"$root"}: a graspd that runs was started from it"
        else
            rm -rf -- "$former"
            did "removed the former ${former#"$root"}"
        fi
    done
}

used() { grep -qsF -- "$1/" /proc/[0-9]*/maps; }

link() {
    if [ -L "$root$command_link" ]; then return; fi
    mkdir -p -- "$root${command_link%/*}"
    ln -s "$prefix/venv/bin/graspd" "$root$command_link"
    did "$command_link leads to it"
}

backoff() {
    version=$(systemctl --version 2>/dev/null | sed -n '1s/^systemd \([0-9]*\).*/\1/p')
    if [ "${version:-0}" -ge 254 ]; then
        put systemd/backoff.conf "$units/graspd@.service.d/backoff.conf"
    fi
}

network() {
    if [ -n "$can" ] || [ -e "$root$network_file" ]; then
        put network/80-graspd-can.network "$network_file"
    fi
}

example() {
    if [ -n "$(find "$root/etc/graspd" -name '*.toml' 2>/dev/null)" ]; then return; fi
    install -D -m 644 -- "$here/scenes/spi.toml" "$root/etc/graspd/right.toml"
    did "wrote an example scene to /etc/graspd/right.toml"
}

activate() {
    systemd-sysusers graspd.conf
    if getent group can >/dev/null && ! id -nG graspd | grep -qw can; then
        usermod -aG can graspd
        did "added graspd to the group can"
    fi
    # A chroot may lack /proc, which this needs; the boot makes the folders then.
    systemd-tmpfiles --create graspd.conf || [ -z "$live" ] || fail "the folders cannot be made"
    reload
}

reload() {
    [ -n "$live" ] || return 0
    systemctl daemon-reload
    case $changed in
        *70-graspd.rules*)
            if udevadm control --reload 2>/dev/null; then # a container has no udev
                udevadm trigger --subsystem-match=tty --subsystem-match=usb-serial
            fi
            ;;
    esac
    case $changed in
        *80-graspd-can.network*)
            if systemctl -q is-active systemd-networkd; then networkctl reload; fi
            ;;
    esac
}

running() {
    [ -n "$live" ] || return 0
    systemctl list-units --plain --no-legend --state=active,reloading,activating \
        'graspd@*.service' | cut -d ' ' -f 1
}

advise() {
    if [ -e "$network_file" ] && ! systemctl -q is-active systemd-networkd; then
        say "can0 waits for systemd-networkd: systemctl enable --now systemd-networkd"
    fi
    case $changed in *"venv is new"* | *"wrote $units"*) ;; *) return 0 ;; esac
    for unit in $(running); do
        say "$unit runs as it was; when its hand is at rest: systemctl restart $unit"
    done
}

start() {
    scene=/etc/graspd/$enable.toml
    [ -f "$scene" ] || fail "there is no $scene; graspd@$enable is not enabled"
    runuser -u graspd -- "$command_link" check "$scene" >"$scratch/check" 2>&1 || {
        cat "$scratch/check" >&2
        fail "graspd@$enable is not enabled"
    }
    if [ -z "$live" ]; then
        systemctl -q enable "graspd@$enable"
        say "graspd@$enable is enabled: it runs after every boot"
        return
    fi
    if systemctl -q is-enabled "graspd@$enable" 2>/dev/null &&
        systemctl -q is-active "graspd@$enable"; then
        say "graspd@$enable is enabled and runs"
        return
    fi
    systemctl -q enable "graspd@$enable"
    systemctl start "graspd@$enable" ||
        fail "graspd@$enable is enabled but does not start: journalctl -u graspd@$enable"
    say "graspd@$enable runs, now and after every boot"
}

remove() {
    [ -n "$root" ] || stop
    if [ -L "$root$command_link" ]; then
        rm -- "$root$command_link"
        did "removed $command_link"
    fi
    each_file drop
    drop backoff.conf "$units/graspd@.service.d/backoff.conf"
    drop network "$network_file"
    for each in "$root$prefix/venv" "$root$prefix/venv.new" "$root$prefix"/venv-*; do
        if [ -L "$each" ] || [ -d "$each" ]; then
            rm -rf -- "$each"
            did "removed ${each#"$root"}"
        fi
    done
    rmdir -- "$root$prefix" 2>/dev/null || true
    [ -n "$root" ] || reload
    if [ -n "$purge" ]; then purge; else keep; fi
    if [ -n "$changed" ]; then say "uninstalled"; else say "nothing to remove"; fi
}

drop() {
    if [ ! -e "$root$2" ]; then return; fi
    rm -- "$root$2"
    did "removed $2"
    folder=${2%/*}
    while [ "${folder%/*}" != /usr/local ] && rmdir -- "$root$folder" 2>/dev/null; do
        folder=${folder%/*}
    done
}

stop() {
    for unit in $(running); do
        systemctl stop "$unit"
        did "stopped $unit"
    done
    for enabled in /etc/systemd/system/*.wants/graspd@*.service; do
        if [ -L "$enabled" ]; then systemctl -q disable "${enabled##*/}"; fi
    done
    [ -z "$live" ] || systemctl reset-failed 'graspd@*.service' 2>/dev/null || true
}

purge() {
    for folder in /etc/graspd /var/lib/graspd /run/graspd; do
        if [ -e "$root$folder" ]; then
            rm -rf -- "$root$folder"
            did "removed $folder"
        fi
    done
    if [ -z "$root" ] && id graspd >/dev/null 2>&1; then
        userdel graspd || fail "the user graspd stays; end its processes, then run this again"
        did "removed the user graspd"
    fi
}

keep() {
    for folder in /etc/graspd /var/lib/graspd; do
        if [ -e "$root$folder" ]; then say "kept $folder (--purge removes it)"; fi
    done
}

main "$@"
