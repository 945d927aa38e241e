"""Systems shared by all jobs: pose recorder, mover, arbiter, limiter, guard, process switch, operator panel."""
