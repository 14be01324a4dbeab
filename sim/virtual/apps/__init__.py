"""The apps of a run under virtual time: records, storage, and steps that do not return."""
