"""Report templates and plots."""
