"""Where every figure of the project comes from: `./run bench AREA [--json]`, each beside its limit."""
