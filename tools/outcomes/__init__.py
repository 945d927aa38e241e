"""What a run came to, measured against the truth where a simulation knows it: the dataclasses that commands return and reports show."""
