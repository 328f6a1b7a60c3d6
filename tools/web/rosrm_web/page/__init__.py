"""The page in the browser, drawn by NiceGUI in the gateway's process.

rows    PURE: rows of the tables, and what is wrong, from a listing
live    reads the cluster while a browser shows the page
site    the page and its tabs
views   hosts, processes and events as tables
dialogs explanation, logs, and confirmation of an action
"""
