"""The procedure of commissioning: events of the robot and of the person in, actions and a report out; no IO."""
