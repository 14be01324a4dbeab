"""The DWM1001's protocols: its bytes, requests and answers, and what its answers say of it. No IO."""
