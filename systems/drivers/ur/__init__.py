"""Driver of Universal Robots controllers: worker process, guard script, pre-flight checks."""
