"""Pictures and recordings. `recording` is the only module of the project that imports rerun."""
