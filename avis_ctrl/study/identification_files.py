"""Names of the files of `avis identify`, in a module of their own that imports nothing slow."""

RIG_FILE, RESULT_FILE = "rig.toml", "result.json"
UNCERTAINTY_FILE, DESIGN_FILE = "uncertainty.json", "design.toml"
REPORT_FILES = ("report.html", "report.pdf")
FILES = (RESULT_FILE, RIG_FILE, UNCERTAINTY_FILE, DESIGN_FILE, *REPORT_FILES)
