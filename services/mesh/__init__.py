"""The mesh service: links to the neighbours, and what is relayed over them."""
