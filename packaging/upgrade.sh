#!/bin/sh
# Upgrades a gateway of this machine to a version that is installed beside the present one, and goes
# back unless it is as well as before: docs/upgrade-fleet.md.
#
#   ssh gw-1 sudo sh -s 1.1.0 hall < packaging/upgrade.sh
#
# Exit code 0: it runs the new version. 1: the version before is back, and as well as before.
# 2: nothing was changed. 3: a person must look.
set -eu

say() { echo "$name: $*" || true; }

# Prints the number of faults; fails without an answer of this version.
faults() {
    answer=$("$home/current/bin/plc-gateway" health "$file" --strict 2>"$wrong") || true
    case $answer in
        *" $1, up "*) wc -l <"$wrong" ;;
        *) return 1 ;;
    esac
}

run() {
    ln -sfn "$1" "$home/current"
    $restart || true # what follows decides
}

# Prints the number of faults after the watch; fails without an answer.
judged() {
    end=$(($(date +%s) + start))
    until faults "$1" >/dev/null; do
        [ "$(date +%s)" -lt "$end" ] || return 1
        sleep 1
    done
    sleep "$watch"
    faults "$1"
}

main() {
    new=${1:?a version} name=${2:?the name of its file in /etc/plc-gateway}
    home=${PLC_GATEWAY_HOME:-/opt/plc-gateway}
    file=${PLC_GATEWAY_FILE:-/etc/plc-gateway/$name.yaml}
    restart=${PLC_GATEWAY_RESTART:-systemctl restart plc-gateway@$name}
    start=${PLC_GATEWAY_START:-60} # seconds until it answers
    watch=${PLC_GATEWAY_WATCH:-30} # seconds until it is judged: devices are `starting` before
    wrong=$(mktemp)
    trap 'rm -f "$wrong"' EXIT
    trap '' HUP PIPE # a lost connection ends nothing halfway

    old=$(basename "$(readlink "$home/current")")
    if [ "$old" = "$new" ]; then
        say "$new is the present version"
        faults "$new" >/dev/null || exit 3
        exit 0
    fi
    if [ ! -x "$home/$new/bin/plc-gateway" ]; then
        say "$home/$new is not installed: nothing was changed"
        exit 2
    fi
    if ! "$home/$new/bin/plc-gateway" check "$file" >/dev/null; then
        say "$new refuses the file: nothing was changed"
        exit 2
    fi
    if ! before=$(faults "$old"); then
        say "it does not answer as $old: nothing was changed"
        exit 2
    fi
    run "$new"
    if after=$(judged "$new") && [ "$after" -le "$before" ]; then
        say "runs $new, with $after faults ($before before)"
        exit 0
    fi
    say "$new is worse: ${after:-no answer}${after:+ faults}, $before before"
    cat "$wrong" || true
    run "$old"
    if after=$(judged "$old") && [ "$after" -le "$before" ]; then
        say "$old is back"
        exit 1
    fi
    say "$old is not well, either: ${after:-no answer}${after:+ faults}"
    exit 3
}

main "$@" # all of it is read before, so the end of the input is no end of the upgrade
