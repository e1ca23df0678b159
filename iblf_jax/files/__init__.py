"""What goes to disk and comes back: scenarios, studies, tunings and robots as TOML, runs as netCDF
and npz.
"""
