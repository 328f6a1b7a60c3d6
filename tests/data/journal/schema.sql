CREATE TABLE record (
    sequence INTEGER PRIMARY KEY, wall REAL NOT NULL, elapsed REAL NOT NULL, kind TEXT NOT NULL,
    process TEXT NOT NULL, host TEXT NOT NULL, message TEXT NOT NULL, facts TEXT NOT NULL
);
CREATE INDEX record_process ON record (process) WHERE process != '';
CREATE TABLE intent (
    tbl TEXT NOT NULL, key TEXT NOT NULL, value TEXT NOT NULL, PRIMARY KEY (tbl, key)
) WITHOUT ROWID;
PRAGMA user_version = 1;
