from avis_ctrl import plot as plot
from avis_ctrl.errors import InputError as InputError
from avis_ctrl.interface.workflow import campaign as campaign
from avis_ctrl.interface.workflow import design as design
from avis_ctrl.interface.workflow import gap as gap
from avis_ctrl.interface.workflow import identify as identify
from avis_ctrl.interface.workflow import rig as rig
from avis_ctrl.interface.workflow import simulate_campaign as simulate_campaign
from avis_ctrl.interface.workflow import single_axis as single_axis
from avis_ctrl.lti import StateSpace as StateSpace
from avis_ctrl.lti import tf as tf
from avis_ctrl.robust.hinfsyn import hinfsyn as hinfsyn
from avis_ctrl.robust.mu import mu as mu
from avis_ctrl.robust.mu_peak import mu_peak as mu_peak
from avis_ctrl.robust.mu_peak import worst_case_gain as worst_case_gain
from avis_ctrl.robust.musyn import musyn as musyn
from avis_ctrl.uncertainty.blocks import BlockStructure as BlockStructure
from avis_ctrl.uncertainty.blocks import ComplexFull as ComplexFull
from avis_ctrl.uncertainty.blocks import ComplexScalar as ComplexScalar
from avis_ctrl.uncertainty.blocks import RealScalar as RealScalar
from avis_ctrl.uncertainty.uncertain_system import complex_disk as complex_disk
from avis_ctrl.uncertainty.uncertain_system import connect as connect
from avis_ctrl.uncertainty.uncertain_system import dynamics as dynamics
from avis_ctrl.uncertainty.uncertain_system import matrix as matrix
from avis_ctrl.uncertainty.uncertain_system import real as real
from avis_ctrl.uncertainty.uncertain_system import ss as ss

__version__: str
