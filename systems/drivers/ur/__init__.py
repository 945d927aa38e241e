"""The hardware interface to a Universal Robots controller: worker process, guard script, pre-flight."""
