//! Materials in engineering units, and the library of built-in ones.

use serde::{Deserialize, Serialize};

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
