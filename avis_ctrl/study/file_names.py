"""Names of the files of `avis identify` and `avis gap`, in a module of their own that imports nothing slow."""

RIG_FILE, RESULT_FILE = "rig.toml", "result.json"
UNCERTAINTY_FILE, DESIGN_FILE = "uncertainty.json", "design.toml"
REPORT_FILES = ("report.html", "report.pdf")
IDENTIFICATION_FILES = (RESULT_FILE, RIG_FILE, UNCERTAINTY_FILE, DESIGN_FILE, *REPORT_FILES)

GAP_FILE = "gap.json"
BASELINE_FILE, UPDATED_FILE = "baseline.json", "updated.json"
BASELINE_RIG, UPDATED_RIG = "baseline.toml", "updated.toml"
GAP_REPORTS = ("gap.html", "gap.pdf")
DESIGN_FOLDER = "design"  # with --design: rig and design file of the updated model
GAP_FILES = (GAP_FILE, BASELINE_FILE, UPDATED_FILE, BASELINE_RIG, UPDATED_RIG, *GAP_REPORTS)
