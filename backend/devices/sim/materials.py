"""What surfaces do with light: diffuse albedo, a specular lobe, a mirror's share."""

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Material(BaseModel):
    """How a surface reflects; the shares are of the light that falls on it."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    albedo: float = Field(ge=0, le=1)
    """Diffuse reflectance (Lambert)."""
    specular: float = Field(0.0, ge=0, le=1)
    """Reflectance of the glossy lobe at normal incidence (GGX microfacets, Schlick's Fresnel term)."""
    roughness: float = Field(0.3, gt=0.01, le=1)
    """Width of the lobe: GGX alpha, about the r.m.s. slope of the facets; 0.1 polished, 0.5 satin."""
    mirror: float = Field(0.0, ge=0, le=1)
    """Share reflected as by a perfect mirror: shows other surfaces in it, and throws the pattern on them."""

    @model_validator(mode="after")
    def _conserves_energy(self) -> "Material":
        total = self.albedo + self.specular + self.mirror
        if total > 1.0 + 1e-9:
            raise ValueError(
                f"albedo {self.albedo:g} + specular {self.specular:g} + mirror {self.mirror:g}"
                f" = {total:g}, a surface can't reflect more than 1"
            )
        return self


MATTE_WHITE = Material(albedo=0.85)
"""What `sprayed:` covers everything with."""
PLASTER = Material(albedo=0.85)
WOOD = Material(albedo=0.36)
DARK_COVER = Material(albedo=0.05)
TABLE = Material(albedo=0.32)
BLACK_PLASTIC = Material(albedo=0.025, specular=0.003, roughness=0.45)
DARK_CAST = Material(albedo=0.12, specular=0.01, roughness=0.5)
"""Sand-cast iron: dark, hardly glossy."""
