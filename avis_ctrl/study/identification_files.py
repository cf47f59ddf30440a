"""Names of the files that `avis identify` writes; apart, so that they are known before anything slow is loaded."""

RIG_FILE, RESULT_FILE = "rig.toml", "result.json"
UNCERTAINTY_FILE, DESIGN_FILE = "uncertainty.json", "design.toml"
REPORT_FILES = ("report.html", "report.pdf")
FILES = (RESULT_FILE, RIG_FILE, UNCERTAINTY_FILE, DESIGN_FILE, *REPORT_FILES)
