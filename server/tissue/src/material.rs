//! Materials in engineering units, and the library of built-in ones.
//!
//! A scene gives Young's modulus, Poisson's ratio, density and friction; for non-linear or anisotropic tissue
//! also the stiffening and the fibre direction. The springs of the lattice follow from them. The built-in
//! values are rounded, each with its source. Living tissue varies by a factor of several between people, sites
//! and methods, so a scene may override every value.

mod library;
mod nearest_name;

pub use library::MATERIAL_NAMES;
pub use nearest_name::nearest_name;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::Vec3;

/// Properties of a material.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Material {
    /// Its name in a scene.
    pub name: String,
    /// Young's modulus in Pa; with fibres, the one across them.
    pub young_pa: f64,
    /// Poisson's ratio: 0.25 for springs alone; 0.5 would be incompressible.
    pub poisson: f64,
    /// Exponent b of the spring curve F = k l0 (exp(b e) - 1)/b over the strain e = (l - l0)/l0;
    /// 0 is the straight line F = k l0 e.
    pub stiffening: f64,
    /// Young's modulus along the fibres over the one across them; 1 is isotropic.
    pub fibre_ratio: f64,
    /// The direction of the fibres; unused when `fibre_ratio` is 1.
    pub fibre_axis: FibreAxis,
    /// Fraction of its rest length at which a compressed spring becomes extreme: it gets no shorter (`α_min` of
    /// Lin 2007, fig. 3.11).
    pub compress_limit: f64,
    /// Multiple of its rest length at which a stretched spring becomes extreme: it gets no longer (`α_max` of
    /// Lin 2007, fig. 3.11).
    pub stretch_limit: f64,
    /// Whether it bottoms out: it hardens when pressed flat, and no cell of it folds. Without it a haptic step
    /// takes a fifth less time, and the lattice buckles sideways from 30 to 40 % of local compression on.
    pub bottoms_out: bool,
    /// Density in kg/m³.
    pub density_kg_m3: f64,
    /// Coefficient of static friction against a tool.
    pub friction_static: f64,
    /// Coefficient of dynamic friction against a tool; not above the static one.
    pub friction_dynamic: f64,
    /// Fracture toughness against a sharp blade in J/m², the work per area of the cut: an edge that cuts feels this force per
    /// length in N/m, and a needle per width.
    pub toughness_j_m2: f64,
    /// Source of the values.
    pub source: String,
}

/// Direction of a region's fibres.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub enum FibreAxis {
    /// Along the region's long axis: the principal axis of its cells' middles.
    #[default]
    Long,
    /// Along this direction of the model, of any length but zero.
    Given([f64; 3]),
}

impl Default for Material {
    /// A soft synthetic material: linear, isotropic, springs alone. For models made by a program; scenes use
    /// the library.
    fn default() -> Self {
        Self {
            name: "plain".to_owned(),
            young_pa: 10e3,
            poisson: POISSON_OF_SPRINGS,
            stiffening: 0.0,
            fibre_ratio: 1.0,
            fibre_axis: FibreAxis::Long,
            compress_limit: COMPRESS_LIMIT_DEFAULT,
            stretch_limit: STRETCH_LIMIT_DEFAULT,
            bottoms_out: true,
            density_kg_m3: 1000.0,
            friction_static: FRICTION_DEFAULT[0],
            friction_dynamic: FRICTION_DEFAULT[1],
            toughness_j_m2: TOUGHNESS_DEFAULT_J_M2,
            source: "round numbers".to_owned(),
        }
    }
}

/// Changes to a material, from `[material.NAME]` or from a region. A field that is `None` keeps its value.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MaterialOverride {
    /// Young's modulus in Pa.
    pub young_pa: Option<f64>,
    /// Poisson's ratio.
    pub poisson: Option<f64>,
    /// Exponent of the spring curve.
    pub stiffening: Option<f64>,
    /// Young's modulus along the fibres over the one across.
    pub fibre_ratio: Option<f64>,
    /// Direction of the fibres.
    pub fibre_axis: Option<FibreAxis>,
    /// Fraction of the rest length at which a compressed spring becomes extreme.
    pub compress_limit: Option<f64>,
    /// Multiple of the rest length at which a stretched spring becomes extreme.
    pub stretch_limit: Option<f64>,
    /// Whether it bottoms out.
    pub bottoms_out: Option<bool>,
    /// Density in kg/m³.
    pub density_kg_m3: Option<f64>,
    /// Coefficient of static friction.
    pub friction_static: Option<f64>,
    /// Coefficient of dynamic friction.
    pub friction_dynamic: Option<f64>,
    /// Fracture toughness in J/m².
    pub toughness_j_m2: Option<f64>,
}

impl MaterialOverride {
    /// Its numbers by scene key, in the units of a scene, in writing order.
    pub fn numbers(&self) -> [(&'static str, Option<f64>); 10] {
        [
            ("young_kpa", self.young_pa.map(|pa| pa * 1e-3)),
            ("poisson", self.poisson),
            ("stiffening", self.stiffening),
            ("fibre_ratio", self.fibre_ratio),
            ("compress_limit", self.compress_limit),
            ("stretch_limit", self.stretch_limit),
            ("density_kg_m3", self.density_kg_m3),
            ("friction_static", self.friction_static),
            ("friction_dynamic", self.friction_dynamic),
            ("toughness_j_m2", self.toughness_j_m2),
        ]
    }
}

/// Range of Young's modulus in Pa. Reason: from the softest gel (1 Pa) to above diamond (1.2e12 Pa); a value
/// outside is in the wrong unit. Outside the range the material is rejected.
pub(crate) const YOUNG_PA_RANGE: [f64; 2] = [1.0, 2e12];

/// Range of the density in kg/m³. Reason: from aerogel (1) to above osmium (22 590); a value outside is in the
/// wrong unit. Outside the range the material is rejected.
pub(crate) const DENSITY_KG_M3_RANGE: [f64; 2] = [1.0, 25_000.0];

/// Largest coefficient of friction. Reason: clean rubber reaches about 2; no material that a tool touches is
/// above 5. Above it the material is rejected.
pub(crate) const FRICTION_MAX: f64 = 5.0;

/// Toughness in J/m² of solids that no hand cuts or pierces: order of magnitude of cortical bone and plastics.
pub(crate) const SOLID_J_M2: f64 = 5_000.0;

/// Pressure of tissue on a needle that has opened it from nothing, relative to Young's modulus: a cavity in rubber grows at
/// this pressure (Gent and Lindley 1959).
const OPENED: f64 = 5.0 / 6.0;

/// Range of the fracture toughness in J/m². Reason: gels are at 1, steel is at 1e5 and cut by no hand. Outside the range the
/// material is rejected.
pub(crate) const TOUGHNESS_J_M2_RANGE: [f64; 2] = [0.0, 1e5];

/// Range of Poisson's ratio. Reason: below 0.25 the volume term would have a negative stiffness. At 0.5 the
/// stiffness would be infinite; at 0.49 it is 48 times that of the springs. Outside the range the material is
/// rejected.
pub(crate) const POISSON_RANGE: [f64; 2] = [POISSON_OF_SPRINGS, 0.49];

/// Range of the exponent of the spring curve. Reason: at 50 a spring stiffens by a factor e per 2 % of strain,
/// beyond the steepest toe region of a tendon. `stretch_limit` models steeper laws. Outside the range the
/// material is rejected.
pub(crate) const STIFFENING_RANGE: [f64; 2] = [0.0, 50.0];

/// Range of the ratio of the moduli along and across fibres. Reason: beyond it some springs would need negative
/// stiffness; muscle and tendon in the literature lie within. Outside the range the material is rejected.
pub(crate) const FIBRE_RATIO_RANGE: [f64; 2] = [0.1, 20.0];

/// Range of the compression limit. Reason: above 0.95 a touch would make the tissue rigid; below 0.05 the cells
/// have folded before. Outside the range the material is rejected.
pub(crate) const COMPRESS_LIMIT_RANGE: [f64; 2] = [0.05, 0.95];

/// Range of the stretch limit. Reason: at 1.01 a touch makes the tissue rigid; 100 is no limit in practice.
/// Outside the range the material is rejected.
pub(crate) const STRETCH_LIMIT_RANGE: [f64; 2] = [1.01, 100.0];

/// Poisson's ratio of springs alone (`springs.rs`).
const POISSON_OF_SPRINGS: f64 = 0.25;

const COMPRESS_LIMIT_DEFAULT: f64 = 0.3;

const STRETCH_LIMIT_DEFAULT: f64 = 3.0;

/// Default friction of a new material.
const FRICTION_DEFAULT: [f64; 2] = [0.4, 0.3];

/// Default toughness of a new material: that of liver under a blade, the best measured soft tissue.
const TOUGHNESS_DEFAULT_J_M2: f64 = 200.0;

/// Why a material was rejected, with the remedy.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{0}")]
pub struct MaterialError(String);

impl Material {
    /// A built-in material.
    pub fn built_in(name: &str) -> Option<Self> {
        library::built_in(name)
    }

    /// Whether a needle enters it.
    pub(crate) fn is_penetrable(&self) -> bool {
        self.toughness_j_m2 < SOLID_J_M2
    }

    /// Traction against a needle along its shaft, static and dynamic, in Pa: friction under the pressure of the tissue that
    /// it has opened.
    pub fn needle_traction_pa(&self) -> [f64; 2] {
        [self.friction_static, self.friction_dynamic].map(|mu| mu * OPENED * self.young_pa)
    }

    /// Its numbers, in the order in which files and hashes have them.
    pub(crate) fn numbers(&self) -> [f64; 10] {
        // Destructured, so that a new field of a material cannot be forgotten here.
        let Self {
            name: _,
            young_pa,
            poisson,
            stiffening,
            fibre_ratio,
            fibre_axis: _,
            compress_limit,
            stretch_limit,
            bottoms_out: _,
            density_kg_m3,
            friction_static,
            friction_dynamic,
            toughness_j_m2,
            source: _,
        } = *self;
        [
            young_pa,
            poisson,
            stiffening,
            fibre_ratio,
            compress_limit,
            stretch_limit,
            density_kg_m3,
            friction_static,
            friction_dynamic,
            toughness_j_m2,
        ]
    }

    /// A built-in material with the scene's changes, or a new one defined by the scene alone.
    pub fn resolve(name: &str, change: Option<&MaterialOverride>) -> Result<Self, MaterialError> {
        let change = match (Self::built_in(name), change) {
            (Some(built_in), None) => return Ok(built_in),
            (Some(built_in), Some(change)) => {
                return built_in.with(change, "changed by the scene; built in");
            }
            (None, None) => {
                let nearest = nearest_name(name, MATERIAL_NAMES.iter().copied());
                let hint = nearest.map(|n| format!(", did you mean \"{n}\"?"));
                return Err(MaterialError(format!(
                    "no material \"{name}\"{}; built in are {}; for one of your own add \
                     [material.{name}] with young_kpa and density_kg_m3",
                    hint.unwrap_or_default(),
                    MATERIAL_NAMES.join(", ")
                )));
            }
            (None, Some(change)) => change,
        };
        let need = |value: Option<f64>, missing: &str| {
            value.ok_or_else(|| {
                MaterialError(format!(
                    "material \"{name}\" is not built in, so [material.{name}] must give {missing}; \
                     built in are {}",
                    MATERIAL_NAMES.join(", ")
                ))
            })
        };
        let plain = Self {
            name: name.to_owned(),
            young_pa: need(change.young_pa, "young_kpa")?,
            density_kg_m3: need(change.density_kg_m3, "density_kg_m3")?,
            ..Self::default()
        };
        Self {
            source: "given by the scene".to_owned(),
            ..plain.with(change, "")?
        }
        .checked()
    }

    /// This material with a scene's changes; `by` names their origin and begins the new source.
    pub fn with(mut self, change: &MaterialOverride, by: &str) -> Result<Self, MaterialError> {
        if *change == MaterialOverride::default() {
            return Ok(self);
        }
        self.young_pa = change.young_pa.unwrap_or(self.young_pa);
        self.poisson = change.poisson.unwrap_or(self.poisson);
        self.stiffening = change.stiffening.unwrap_or(self.stiffening);
        self.fibre_ratio = change.fibre_ratio.unwrap_or(self.fibre_ratio);
        self.fibre_axis = change.fibre_axis.unwrap_or(self.fibre_axis);
        self.compress_limit = change.compress_limit.unwrap_or(self.compress_limit);
        self.stretch_limit = change.stretch_limit.unwrap_or(self.stretch_limit);
        self.bottoms_out = change.bottoms_out.unwrap_or(self.bottoms_out);
        self.density_kg_m3 = change.density_kg_m3.unwrap_or(self.density_kg_m3);
        // A single coefficient takes the other one along where the two would contradict.
        let [statik, dynamic] = [change.friction_static, change.friction_dynamic];
        self.friction_static = statik.unwrap_or(self.friction_static.max(dynamic.unwrap_or(0.0)));
        self.friction_dynamic = dynamic.unwrap_or(self.friction_dynamic.min(self.friction_static));
        self.toughness_j_m2 = change.toughness_j_m2.unwrap_or(self.toughness_j_m2);
        self.source = format!("{by}: {}", self.source);
        self.checked()
    }

    /// This material, if every number is in range.
    fn checked(self) -> Result<Self, MaterialError> {
        let bad = |key: &str, value: f64, range: String| {
            let name = &self.name;
            let text = format!("material \"{name}\": {key} = {value} must be {range}");
            Err(MaterialError(text))
        };
        for (key, value, [low, high], unit) in self.ranges() {
            // Written so that a NaN fails.
            if !(low..=high).contains(&value) {
                return bad(key, value, format!("between {low} and {high}{unit}"));
            }
        }
        if !(0.0..=self.friction_static).contains(&self.friction_dynamic) {
            let range = format!("between 0 and friction_static = {}", self.friction_static);
            return bad("friction_dynamic", self.friction_dynamic, range);
        }
        if let FibreAxis::Given(axis) = self.fibre_axis {
            let length = Vec3::from(axis).norm();
            if !(length.is_finite() && length > 0.0) {
                let range = "the components of a direction, not all zero".to_owned();
                return bad("fibres", length, range);
            }
        }
        Ok(self)
    }

    /// Each number with its scene key, its range, and its unit in a scene.
    fn ranges(&self) -> [(&'static str, f64, [f64; 2], &'static str); 9] {
        let young_kpa = YOUNG_PA_RANGE.map(|pa| pa * 1e-3);
        let friction = [0.0, FRICTION_MAX];
        [
            ("young_kpa", self.young_pa * 1e-3, young_kpa, " kPa"),
            ("poisson", self.poisson, POISSON_RANGE, ""),
            ("stiffening", self.stiffening, STIFFENING_RANGE, ""),
            ("fibre_ratio", self.fibre_ratio, FIBRE_RATIO_RANGE, ""),
            (
                "compress_limit",
                self.compress_limit,
                COMPRESS_LIMIT_RANGE,
                "",
            ),
            ("stretch_limit", self.stretch_limit, STRETCH_LIMIT_RANGE, ""),
            (
                "density_kg_m3",
                self.density_kg_m3,
                DENSITY_KG_M3_RANGE,
                " kg/m³",
            ),
            ("friction_static", self.friction_static, friction, ""),
            (
                "toughness_j_m2",
                self.toughness_j_m2,
                TOUGHNESS_J_M2_RANGE,
                " J/m²",
            ),
        ]
    }
}
