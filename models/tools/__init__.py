"""Tools as users describe them: the file's schema, its reader, and the welding tool's own file."""
