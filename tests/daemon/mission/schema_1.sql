CREATE TABLE exposures (
    number INTEGER PRIMARY KEY,
    state TEXT NOT NULL CHECK (state IN ('stored', 'complete', 'degraded', 'lost')),
    is_sealed INTEGER NOT NULL CHECK (is_sealed IN (0, 1)),
    trigger_sequence INTEGER NOT NULL,
    trigger_mono_ns INTEGER NOT NULL,
    boot_id TEXT NOT NULL,
    mark_gps_ns INTEGER,
    mark_sigma_ns INTEGER,
    mark_source TEXT NOT NULL DEFAULT 'none',
    latitude_deg REAL,
    longitude_deg REAL,
    height_m REAL,
    line_id TEXT NOT NULL,
    flags INTEGER NOT NULL,
    is_simulated INTEGER NOT NULL,
    record_sha256 TEXT,
    previous_sha256 TEXT,
    seal_order INTEGER UNIQUE
) STRICT;
CREATE TABLE frames (
    number INTEGER NOT NULL REFERENCES exposures (number) ON DELETE CASCADE,
    sensor TEXT NOT NULL,
    file TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    mid_exposure_gps_ns INTEGER,
    PRIMARY KEY (number, sensor)
) STRICT;
CREATE TABLE products (
    number INTEGER NOT NULL,
    file TEXT NOT NULL,
    nbytes INTEGER NOT NULL,
    verdict TEXT,
    PRIMARY KEY (number, file)
) STRICT;
CREATE TABLE events (
    id INTEGER PRIMARY KEY,
    boot_id TEXT NOT NULL,
    mono_ns INTEGER NOT NULL,
    source TEXT NOT NULL,
    name TEXT NOT NULL,
    is_fault INTEGER NOT NULL,
    sentence TEXT NOT NULL
) STRICT;
