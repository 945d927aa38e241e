"""What a person or CI runs: the command line, benchmarks, studies, reports."""
