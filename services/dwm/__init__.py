"""UWB localization of one robot: the module's protocol, calibration, filters, the pose."""
