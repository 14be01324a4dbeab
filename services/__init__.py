"""One process a concern: they meet on the bus, never by import (docs/explanation/architecture.md)."""
