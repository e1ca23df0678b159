"""Files: scenarios, studies, tunings, identifications and robots as TOML, runs as netCDF or npz."""
