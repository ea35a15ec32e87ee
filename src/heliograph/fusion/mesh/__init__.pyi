"""Names that other folders take; the package loads them when first used."""

from .graph import Graph as Graph
from .graph import Neighbours as Neighbours
from .graph import find_upstream_nodes as find_upstream_nodes
from .graph import graph_of as graph_of
from .graph import neighbours_of as neighbours_of
from .joint_error_covariance import blocks_of as blocks_of
from .joint_error_covariance import error_transitions as error_transitions
from .joint_error_covariance import measurement_weights as measurement_weights
from .joint_error_covariance import propagate_joint_covariance as propagate_joint_covariance
from .joint_error_covariance import scatter_blocks as scatter_blocks
from .neighbour_rules import DiffusionWeights as DiffusionWeights
from .neighbour_rules import FrozenWeights as FrozenWeights
from .node_gains import NeighbourEstimates as NeighbourEstimates
from .node_gains import NeighbourWeights as NeighbourWeights
from .node_gains import NodeGains as NodeGains
from .node_gains import NodeStep as NodeStep
from .node_gains import correct_by_information as correct_by_information
from .node_gains import gains_of as gains_of
from .node_gains import information_of as information_of
