"""The pages on rig and design files list every key that the readers take, and no other; their examples are read."""

import re
import tomllib
from pathlib import Path

from avis_ctrl.rigs.file_errors import keys_of, section_in
from avis_ctrl.rigs.rig_file import rig_from
from avis_ctrl.rigs.rig_sections import AvisFile, HalcyonicsFile
from avis_ctrl.study.design_file import Design, design_from_table
from avis_ctrl.study.uncertainty_file import UncertaintyFile

DOCS = Path(__file__).parents[2] / "docs"
# "## Isolators: `[payload]`" or "## `[[requirement]]`, a line of ..."
HEADING = re.compile(r"^## (?:(Isolators|Springs|Both kinds): )?(?:`\[+([\w.]+)\]+`)?.*?$(.*?)(?=^## |\Z)", re.S | re.M)


def page(name):
    text = (DOCS / name).read_text()
    return tomllib.loads(re.search(r"```toml\n(.*?)```", text, re.S)[1]), text


def listed(text, kinds):
    """Keys by section, out of the first columns of the tables."""
    found = {}
    for kind, section, rows in HEADING.findall(text):
        if kind in kinds:
            own = re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`.*?) \|", rows, re.M)))
            found.setdefault(section, set()).update(own)  # text after the tables has no section of its own
    return found


def keys(model, prefix="", top=True):
    """Keys by section, out of the reader's models; sections inside sections by their dotted name."""
    found, own = {}, set()
    for name, annotation in keys_of(model).items():
        inner = section_in(annotation)
        if inner is UncertaintyFile:
            inner = None
        if inner is None:
            own.add(name)
        else:
            own |= {name} if top else set()
            found |= keys(inner, f"{prefix}{name}.", top=False)
    return {prefix.rstrip("."): own} | found


def test_the_page_on_rig_files_lists_every_key():
    example, text = page("rig_file.md")
    rig = rig_from(example)
    assert len(rig.all_drives) == 2 and [one.quantity for one in rig.sensors()] == [
        "velocity",
        "acceleration",
        "displacement",
    ]
    assert listed(text, ("Isolators", "Both kinds")) == keys(AvisFile)
    assert listed(text, ("Springs", "Both kinds")) == keys(HalcyonicsFile)


def test_the_page_on_design_files_lists_every_key():
    example, text = page("design_file.md")
    assert design_from_table(example).keep == ["z", "phi_x"]
    found = listed(text, ("",))
    sections = {name for name in keys(Design) if name}
    found[""] |= {name for name in sections if "." not in name}  # the page says a section's name in its heading
    assert found == keys(Design)
