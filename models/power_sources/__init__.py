"""Register maps of power sources, as YAML."""
