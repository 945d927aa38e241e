"""URScript as the emulated controller runs it: parser, compiler and built-in functions."""
