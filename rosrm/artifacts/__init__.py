"""Contents of artifacts, as archives that are named by their digests.

pack.py     a file or directory as an archive, on the submitting machine
unpack.py   an archive as a directory, on the host of a process
tar_entries.py  the entries of an archive, with bounded headers
store.py    the archives at the master
cache.py    the unpacked artifacts on a host
"""
