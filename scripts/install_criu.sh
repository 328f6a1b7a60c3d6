#!/bin/sh
# Install the distribution's newest CRIU into a folder, without root and without changes to the
# system: apt resolves and downloads it with all libraries, `dpkg-deb` unpacks, `patchelf` binds the
# program to its own libraries. Used by `make setup`; users: docs/how-to/criu.md.
#
#   scripts/install_criu.sh [FOLDER]     default: ROSRM_CRIU_PREFIX, else below the user's data
#
#   FOLDER/bin/criu     a link into the tree in use; changed last, atomically
#   FOLDER/trees/*      unpacked packages; the program is a real binary, so that it can be given
#                       capabilities
#   FOLDER/packages/    the package files: a second installation, or one on a host without network
#                       to which they are copied, downloads nothing
#
# MIRROR=URL names another mirror than those of apt's sources; SUITE=NAME another release.
set -eu

fail() {
    echo "install_criu: $*; or build CRIU: docs/how-to/criu.md" >&2
    exit 1
}

folder=${1:-${ROSRM_CRIU_PREFIX:-${XDG_DATA_HOME:-$HOME/.local/share}/rosrm/criu}}
case $folder in
/*) ;;
*) folder=$PWD/$folder ;;
esac
case $folder in
*[:\;\$\"\\]*) fail "the dynamic linker does not read : ; \$ \" or \\ in $folder: name another folder" ;;
esac
if version=$("$folder/bin/criu" --version 2>/dev/null); then
    echo "CRIU ${version#Version: } is there already: $folder/bin/criu"
    exit 0
fi

# shellcheck source=/dev/null
id=$(. /etc/os-release && echo "$ID ${ID_LIKE:-}") # the first one that has packages
case " $id " in
" debian "*) suite=sid components=main keyring=debian-archive-keyring ;;
*" ubuntu "*) suite=devel components="main universe" keyring=ubuntu-archive-keyring ;;
*" debian "*) suite=sid components=main keyring=debian-archive-keyring ;;
*) fail "there are no packages for $id" ;;
esac
suite=${SUITE:-$suite}
for program in apt-get dpkg-deb flock; do
    command -v "$program" >/dev/null || fail "the command $program is missing"
done

mkdir -p "$folder/trees" || fail "the folder $folder cannot be used"
exec 9>"$folder/lock"
flock --nonblock 9 || fail "another installation into $folder is under way"
rm -rf "$folder"/fetching.* # of a killed installation
place=$(mktemp -d "$folder/fetching.XXXXXX")
tree=
trap 'rm -rf "$place" ${tree:+"$tree"}' EXIT
trap 'exit 1' HUP INT TERM

# Download with apt's own lists, cache and status in our folder: there nothing is installed, so that
# the packages include all libraries, even the C library.
download() {
    mkdir -p "$place/state/lists/partial" "$place/cache/archives/partial"
    : >"$place/status"
    cat >"$place/apt.conf" <<-END
	#clear APT::Update::Pre-Invoke;
	#clear APT::Update::Post-Invoke;
	#clear APT::Update::Post-Invoke-Success;
	#clear APT::Architectures;
	APT::Architectures { "$(dpkg --print-architecture)"; };
	APT::Sandbox::User "root";
	Acquire::Languages "none";
	Acquire::Retries "1";
	Acquire::http::Timeout "20";
	Acquire::https::Timeout "20";
	Dir::Etc::sourcelist "$place/archive.sources";
	Dir::Etc::sourceparts "/dev/null";
	Dir::Etc::preferences "/dev/null";
	Dir::Etc::preferencesparts "/dev/null";
	Dir::State "$place/state";
	Dir::State::status "$place/status";
	Dir::Cache "$place/cache";
	END
    mirrors=${MIRROR:-$(apt-get update --print-uris | sed -n "s#^'\([^']*\)/dists/[^']*/InRelease'.*#\1#p" | uniq)}
    for mirror in $mirrors; do
        echo "asking $mirror for the packages of $suite (about 12 MB)"
        # Only the distribution's own key counts, so that no third party's archive is used.
        cat >"$place/archive.sources" <<-END
		Types: deb
		URIs: $mirror
		Suites: $suite
		Components: $components
		Signed-By: /usr/share/keyrings/$keyring.gpg
		END
        if apt-get -q -c "$place/apt.conf" update --error-on=any >"$place/log" 2>&1 &&
            apt-get -q -c "$place/apt.conf" install --yes --download-only --no-install-recommends \
                criu patchelf >"$place/log" 2>&1; then
            mkdir "$place/packages"
            mv "$place"/cache/archives/*.deb "$place/packages"
            rm -rf "$folder/packages"
            mv "$place/packages" "$folder/packages"
            return
        fi
        echo "  $(grep -m 1 '^E: ' "$place/log" || tail -n 1 "$place/log")" >&2
    done
    fail "no mirror has CRIU for this machine (asked: $(echo ${mirrors:-none}))"
}

set -- "$folder"/packages/*.deb
if [ ! -e "$1" ]; then
    download
fi
tree=$(mktemp -d "$folder/trees/XXXXXX")
chmod 755 "$tree"
for package in "$folder"/packages/*.deb; do
    dpkg-deb --extract "$package" "$tree"
done
# Packages before Debian 13 have libraries outside /usr, too.
libraries=$(find "$tree/usr/lib" "$tree/lib" -maxdepth 1 -name '*-linux-*' 2>/dev/null | paste -sd:)
loader=$(find "$tree/usr/lib" "$tree/lib" -name 'ld-linux*.so.*' 2>/dev/null | head -n 1)
# patchelf sets DT_RUNPATH by default; only DT_RPATH also applies to the libraries' libraries.
"$loader" --library-path "$libraries" "$tree/usr/bin/patchelf" --set-interpreter "$loader" \
    --force-rpath --set-rpath "$libraries" "$tree/usr/sbin/criu"
version=$("$tree/usr/sbin/criu" --version) || fail "the unpacked CRIU does not start"

mkdir -p "$folder/bin"
ln -sf "../trees/${tree##*/}/usr/sbin/criu" "$folder/bin/criu.new"
mv -T "$folder/bin/criu.new" "$folder/bin/criu"
find "$folder/trees" -mindepth 1 -maxdepth 1 ! -path "$tree" -exec rm -rf {} +
tree=
echo "CRIU ${version#Version: } is installed: $folder/bin/criu"
