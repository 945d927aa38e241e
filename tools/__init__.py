"""What an operator or CI runs: the command line, benchmarks, studies, reports."""
