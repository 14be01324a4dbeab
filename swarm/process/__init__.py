"""The life cycle of a process: start, readiness, watchdog, logging, runtime paths and locks."""
