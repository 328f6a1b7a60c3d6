"""The log archive: copies of the logs of all hosts in one directory, bounded and compressed.

`rosrm collect-logs` writes it; `rosrm logs` and the page read it when a host is gone. No module
here knows ROS.
"""
