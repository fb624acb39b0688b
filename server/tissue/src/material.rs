//! Materials in engineering units, and the library of built-in ones.
//!
//! A person gives Young's modulus, density and friction; the springs of the lattice follow from
//! them. The built-in values are rounded, each with where it comes from; living tissue varies by
//! a factor of several between people, sites and methods, so a scene may override every one.

mod library;

pub use library::MATERIAL_NAMES;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// What a region is made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Material {
    /// The name it goes by in a scene.
    pub name: String,
    /// Young's modulus in Pa.
    pub young_pa: f64,
    /// Density in kg/m³.
    pub density_kg_m3: f64,
    /// Coefficient of static friction against a tool.
    pub friction_static: f64,
    /// Coefficient of dynamic friction against a tool; not above the static one.
    pub friction_dynamic: f64,
    /// Where the numbers come from.
    pub source: String,
}

/// What a scene says about a material: `[material.NAME]`. What is `None` stays as it is built in.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MaterialOverride {
    /// Young's modulus in Pa.
    pub young_pa: Option<f64>,
    /// Density in kg/m³.
    pub density_kg_m3: Option<f64>,
    /// Coefficient of static friction.
    pub friction_static: Option<f64>,
    /// Coefficient of dynamic friction.
    pub friction_dynamic: Option<f64>,
}

/// Young's modulus in Pa a material may have. Reason: from the softest gel (1 Pa) to above
/// diamond (1.2e12 Pa); a value outside is a slip of unit. At the bound the material is refused.
pub(crate) const YOUNG_PA_RANGE: [f64; 2] = [1.0, 2e12];

/// Density in kg/m³ a material may have. Reason: from aerogel (1) to above osmium (22 590); a
/// value outside is a slip of unit. At the bound the material is refused.
pub(crate) const DENSITY_KG_M3_RANGE: [f64; 2] = [1.0, 25_000.0];

/// Largest coefficient of friction. Reason: clean rubber reaches about 2; above 5 nothing a tool
/// touches. At the bound the material is refused.
pub(crate) const FRICTION_MAX: f64 = 5.0;

/// Friction of a new material for which the scene gives none.
const FRICTION_DEFAULT: [f64; 2] = [0.4, 0.3];

/// Why a material was refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MaterialError {
    /// Neither built in nor described by the scene.
    #[error(
        "no material \"{name}\"{}; built in are {}; for one of your own add \
         [material.{name}] with young_kpa and density_kg_m3",
        nearest.as_ref().map(|n| format!(", did you mean \"{n}\"?")).unwrap_or_default(),
        MATERIAL_NAMES.join(", ")
    )]
    Unknown {
        /// The name asked for.
        name: String,
        /// The most similar known name.
        nearest: Option<String>,
    },
    /// A new material without all it needs.
    #[error(
        "material \"{name}\" is not built in, so [material.{name}] must give {missing}; built \
         in are {}",
        MATERIAL_NAMES.join(", ")
    )]
    Incomplete {
        /// The material.
        name: String,
        /// The key that is missing.
        missing: &'static str,
    },
    /// A number out of range.
    #[error("material \"{name}\": {key} = {value} must be {range}")]
    OutOfRange {
        /// The material.
        name: String,
        /// The key of the scene.
        key: &'static str,
        /// What it says.
        value: f64,
        /// What it may be.
        range: String,
    },
}

impl Material {
    /// A built-in material.
    pub fn built_in(name: &str) -> Option<Self> {
        library::built_in(name)
    }

    /// A built-in material with the scene's changes, or a new one from the scene alone.
    pub fn resolve(name: &str, change: Option<&MaterialOverride>) -> Result<Self, MaterialError> {
        let change = match (Self::built_in(name), change) {
            (Some(built_in), None) => return Ok(built_in),
            (Some(built_in), Some(change)) => return built_in.with(change),
            (None, None) => {
                let nearest = crate::scene::nearest(name, MATERIAL_NAMES.iter().copied());
                return Err(MaterialError::Unknown {
                    name: name.to_owned(),
                    nearest: nearest.map(str::to_owned),
                });
            }
            (None, Some(change)) => change,
        };
        let need = |value: Option<f64>, missing| {
            value.ok_or(MaterialError::Incomplete {
                name: name.to_owned(),
                missing,
            })
        };
        let friction_static = change
            .friction_static
            .unwrap_or_else(|| FRICTION_DEFAULT[0].max(change.friction_dynamic.unwrap_or(0.0)));
        Self {
            name: name.to_owned(),
            young_pa: need(change.young_pa, "young_kpa")?,
            density_kg_m3: need(change.density_kg_m3, "density_kg_m3")?,
            friction_static,
            friction_dynamic: change
                .friction_dynamic
                .unwrap_or(FRICTION_DEFAULT[1].min(friction_static)),
            source: "given by the scene".to_owned(),
        }
        .checked()
    }

    /// Itself with the scene's changes.
    fn with(mut self, change: &MaterialOverride) -> Result<Self, MaterialError> {
        if *change == MaterialOverride::default() {
            return Ok(self);
        }
        self.young_pa = change.young_pa.unwrap_or(self.young_pa);
        self.density_kg_m3 = change.density_kg_m3.unwrap_or(self.density_kg_m3);
        // Whoever gives one coefficient means the other to follow where it would contradict.
        let [statik, dynamic] = [change.friction_static, change.friction_dynamic];
        self.friction_static = statik.unwrap_or(self.friction_static.max(dynamic.unwrap_or(0.0)));
        self.friction_dynamic = dynamic.unwrap_or(self.friction_dynamic.min(self.friction_static));
        self.source = format!("changed by the scene; built in: {}", self.source);
        self.checked()
    }

    /// Itself, when every number is in range.
    fn checked(self) -> Result<Self, MaterialError> {
        let bad = |key, value: f64, range: String| {
            Err(MaterialError::OutOfRange {
                name: self.name.clone(),
                key,
                value,
                range,
            })
        };
        let [low, high] = YOUNG_PA_RANGE.map(|pa| pa * 1e-3);
        let young_kpa = self.young_pa * 1e-3;
        if !(low..=high).contains(&young_kpa) {
            return bad(
                "young_kpa",
                young_kpa,
                format!("between {low} and {high} kPa"),
            );
        }
        let [low, high] = DENSITY_KG_M3_RANGE;
        if !(low..=high).contains(&self.density_kg_m3) {
            let range = format!("between {low} and {high} kg/m³");
            return bad("density_kg_m3", self.density_kg_m3, range);
        }
        if !(0.0..=FRICTION_MAX).contains(&self.friction_static) {
            let range = format!("between 0 and {FRICTION_MAX}");
            return bad("friction_static", self.friction_static, range);
        }
        if !(0.0..=self.friction_static).contains(&self.friction_dynamic) {
            let range = format!("between 0 and friction_static = {}", self.friction_static);
            return bad("friction_dynamic", self.friction_dynamic, range);
        }
        Ok(self)
    }
}
