"""What the lab's tests have measured (`record_property("measured", TEXT)`) is shown at the end."""

import pytest


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [report for state in ("passed", "failed") for report in terminalreporter.getreports(state)]
    told = [(report.nodeid, text) for report in reports for name, text in report.user_properties if name == "measured"]
    if told:
        terminalreporter.section("measured")
    for test, text in sorted(told):
        terminalreporter.write_line(f"{test.partition('::')[2]}: {text}")
