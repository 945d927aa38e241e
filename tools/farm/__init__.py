"""Runs independent tasks of a study on all cores or on a Dask cluster, and resumes after a kill."""
