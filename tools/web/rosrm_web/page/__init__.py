"""The page in the browser, drawn by NiceGUI in the gateway's process.

rows            PURE: rows of the tables, and what is wrong, from a listing
tree            PURE: rows of processes and their groups
plan_rows       PURE: cells and sentences on planned changes
live            reads the cluster while a browser shows the page
site            the page and its tabs
views           the grid of all tables, and the columns of hosts and events
processes       the tree of processes, with its search
applications    applications and modes
plans           dialogs with the plan of a change
dialogs         explanation, logs, and confirmation of an action
timeline        PURE: picture of processes over hosts, from the events and a listing
timeline_feed   the events, for all browsers
timeline_chart  the picture as options of ECharts
timeline_view   the picture with its controls, and the same as a table
"""
