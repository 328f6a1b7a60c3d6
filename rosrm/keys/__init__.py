"""Keys: who may speak with whom in a cluster, and the sealing of what they say.

`derivation` computes all keys from the cluster's secret, `sealing` encrypts and authenticates
messages, `roles` says which role may send which request, `cluster` is the master's side (the secret
and its principals), and `key_files` reads and writes all of it. Nothing here knows ROS. The format
is documented in docs/reference/keys.md.
"""
