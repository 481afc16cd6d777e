"""Materials, analytic and measured: how a surface point reflects light, one model a file."""

from prt_torch.assets.brdf.albedo import directional_albedo, lobe_quadrature
from prt_torch.assets.brdf.ashikhmin_shirley import AshikhminShirley
from prt_torch.assets.brdf.base import BRDF, Colour
from prt_torch.assets.brdf.cook_torrance import CookTorrance
from prt_torch.assets.brdf.cornell import Cornell
from prt_torch.assets.brdf.ggx import GGX
from prt_torch.assets.brdf.lafortune import Lafortune, LafortuneLobe
from prt_torch.assets.brdf.lambert import Lambert
from prt_torch.assets.brdf.merl import MERL
from prt_torch.assets.brdf.phong import BlinnPhong, Phong
from prt_torch.assets.brdf.registry import MEASURED_NAMES, NAMES, brdf
from prt_torch.assets.brdf.rgl import RGL
from prt_torch.assets.brdf.schlick import Schlick
from prt_torch.assets.brdf.sum import Sum

__all__ = [
    "BRDF",
    "GGX",
    "MEASURED_NAMES",
    "MERL",
    "NAMES",
    "RGL",
    "AshikhminShirley",
    "BlinnPhong",
    "Colour",
    "CookTorrance",
    "Cornell",
    "Lafortune",
    "LafortuneLobe",
    "Lambert",
    "Phong",
    "Schlick",
    "Sum",
    "brdf",
    "directional_albedo",
    "lobe_quadrature",
]
