"""Names of the files of `avis gap`, in a module of their own that imports nothing slow."""

GAP_FILE = "gap.json"
BASELINE_FILE, UPDATED_FILE = "baseline.json", "updated.json"
BASELINE_RIG, UPDATED_RIG = "baseline.toml", "updated.toml"
GAP_REPORTS = ("gap.html", "gap.pdf")
DESIGN_FOLDER = "design"  # with --design: rig and design file of the updated model
GAP_FILES = (GAP_FILE, BASELINE_FILE, UPDATED_FILE, BASELINE_RIG, UPDATED_RIG, *GAP_REPORTS)
