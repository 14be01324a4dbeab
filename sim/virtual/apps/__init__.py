"""What a run under virtual time keeps and watches of the apps: records, storage, steps that do not return."""
