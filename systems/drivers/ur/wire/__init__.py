"""The connections to a controller: RTDE, dashboard and the line under both."""
