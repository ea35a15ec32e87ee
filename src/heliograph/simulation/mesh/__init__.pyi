"""Names that other folders take; the package loads them when first used."""

from .building import DENSE as DENSE
from .building import build_mesh as build_mesh
from .building import build_meshes as build_meshes
from .check import check_mesh as check_mesh
from .check import find_claim_of_mesh as find_claim_of_mesh
from .mesh import Mesh as Mesh
from .node_filter import NodeFilter as NodeFilter
from .node_filter import node_network as node_network
