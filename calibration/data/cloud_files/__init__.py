"""Forms of point clouds and depth images."""
