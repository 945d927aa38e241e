"""What README and docs cite, and the papers' tables: each study prints its rows."""
