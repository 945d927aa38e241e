"""Speed and accuracy tables that anyone can run again."""
