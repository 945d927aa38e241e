"""Datasets, clouds, tables and results: reading and writing, every refusal named."""
