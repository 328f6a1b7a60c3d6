"""HTTP gateway of a cluster: a process of its own, and a client of the master like any other.

`serving` listens. `guard` checks each request before `app` routes it to `reading`, `acting` or
`changes`; `page` draws the page in the browser. `master_link` sends requests to the master,
`watching` checks that the master answers, `tasks` keeps what serves until the end running, and
`problems` turns errors into answers.
"""
