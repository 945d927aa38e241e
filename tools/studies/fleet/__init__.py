"""Study of a fleet: made cells, some of which move, drift or break, and what the fleet's page says of them."""
