"""A scenario's keys as documentation: the reference page, the JSON schema for editors, and a commented cell of one's own."""
