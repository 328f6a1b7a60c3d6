#!/usr/bin/env bash
# Run make targets of the committed checkout in a new Debian with only the packages that the README names.
#
#   sudo scripts/fresh_root.sh bookworm setup demo test     Debian 12; trixie is Debian 13
#   sudo scripts/fresh_root.sh trixie setup --offline test  targets after --offline have only loopback
#
# Needs mmdebstrap, and room for 4 GB below TMPDIR. The root is removed at the end, unless KEEP=1.
set -euo pipefail
(($# >= 2)) || { sed -n '2,8s/^# \{0,1\}//p' "$0" >&2; exit 2; }
suite=$1
shift

checkout=$(git -C "$(dirname "${BASH_SOURCE[0]}")" rev-parse --show-toplevel)
packages=$(sed -n 's/^compiler (Debian, Ubuntu: `\(.*\)`):$/\1/p' "$checkout/README.md")
[[ -n $packages ]] || { echo "fresh_root: the README no longer names the packages of Debian" >&2; exit 1; }

root=$(mktemp --directory --tmpdir "rosrm-$suite.XXXXXX")
remove() { [[ ${KEEP:-} ]] && echo "kept: $root" || rm -rf --one-file-system "$root"; }
trap remove EXIT
mmdebstrap --quiet --variant=minbase --include="ca-certificates ${packages}" "$suite" "$root"
# Pip trusts what this machine trusts, such as the authority of a proxy.
cp /etc/resolv.conf "$root/etc/"
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/"
git clone --quiet --no-hardlinks "$checkout" "$root/root/rosrm"

# Everything that runs inside ends with the namespace of processes, and so do its mounts.
inside=(unshare --mount --pid --fork --kill-child --mount-proc --propagation private)
offline=
for target in "$@"; do
  if [[ $target == --offline ]]; then
    offline=--net
    continue
  fi
  echo "== $suite: make $target ${offline:+(without a network)}"
  env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 ${PIP_CERT:+PIP_CERT="$PIP_CERT"} \
    "${inside[@]}" $offline bash -euc '
      [[ -z $3 ]] || python3 -c "
import fcntl, socket, struct
with socket.socket() as one:  # the loopback interface of a new namespace is down
    fcntl.ioctl(one, 0x8914, struct.pack(\"16sh\", b\"lo\", 0x49))"
      mount --bind "$1" "$1"  # so that "/" inside is a mount, as on any machine
      mount --rbind /dev "$1/dev"
      mount --rbind /sys "$1/sys"
      mount -t proc proc "$1/proc"
      exec chroot "$1" /bin/sh -c "cd /root/rosrm && exec make $2 </dev/null"' - "$root" "$target" "$offline"
done
