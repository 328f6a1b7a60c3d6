"""Keys of hosts and users, their roles, and the sealing of messages. Nothing here imports ROS.

The page "Keys" of the reference documents the format.

roles.py        principals, their roles, and the requests that each role may send
hashing.py      BLAKE2b digests, with or without a key
derivation.py   derivation of all keys from the cluster's secret
sealing.py      encryption and authentication of the messages of one channel
links.py        both ends of the messages under one key
link_packets.py packets that measure the link between two slaves
tickets.py      permission to send requests to a slave
handoffs.py     keys of instances and handoffs
names.py        texts that name these keys in sealed messages
cluster.py      the cluster's secret and its principals, at the master
key_files.py    reading and writing of key files
security.py     keys, peers and signatures of a master, slave or client
finding.py      choice of the security from a user's key files
"""
