"""The processes of a robot, one for each concern. They meet on the bus, never by import
(docs/explanation/architecture.md)."""
