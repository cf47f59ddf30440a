"""Names of the files that `avis gap` writes; apart, so that they are known before anything slow is loaded."""

GAP_FILE = "gap.json"
BASELINE_FILE, UPDATED_FILE = "baseline.json", "updated.json"
BASELINE_RIG, UPDATED_RIG = "baseline.toml", "updated.toml"
GAP_REPORTS = ("gap.html", "gap.pdf")
GAP_FILES = (GAP_FILE, BASELINE_FILE, UPDATED_FILE, BASELINE_RIG, UPDATED_RIG, *GAP_REPORTS)
