"""Everything of Gyrobench that can fail for outside reasons: devices, processes, SQLite, HTTP, documents."""

__version__ = "0.1.0"
