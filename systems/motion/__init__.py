"""The systems that every job shares: pose recorder, mover, arbiter, limiter, guard, process switch, operator panel."""
