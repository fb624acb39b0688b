//! From a scene to its TOML text.

use super::{SCENE_FORMAT, Scene};
use crate::surface::Unit;

impl Scene {
    /// The scene as a TOML text that [`Scene::parse`] reads back as the same scene (up to the
    /// last digit of a converted unit).
    pub fn to_toml(&self) -> String {
        let mut out = format!("format = \"{SCENE_FORMAT}\"\n");
        out += &format!("spacing_mm = {}\n", number(self.spacing_m * 1e3));
        if !self.pinned.is_empty() {
            let names: Vec<String> = self.pinned.iter().map(|n| quoted(n)).collect();
            out += &format!("pinned = [{}]\n", names.join(", "));
        }
        for region in &self.regions {
            out += &format!("\n[[region]]\nname = {}\n", quoted(&region.name));
            // Forward slashes are read on every system.
            let surface = region.surface.to_string_lossy().replace('\\', "/");
            out += &format!("surface = {}\n", quoted(&surface));
            out += &format!("material = {}\n", quoted(&region.material));
            if region.unit == Unit::Metre {
                out += "unit = \"m\"\n";
            }
        }
        for (name, change) in &self.materials {
            out += &format!("\n[material.{}]\n", quoted(name));
            let values = [
                ("young_kpa", change.young_pa.map(|pa| pa * 1e-3)),
                ("density_kg_m3", change.density_kg_m3),
                ("friction_static", change.friction_static),
                ("friction_dynamic", change.friction_dynamic),
            ];
            for (key, value) in values {
                if let Some(value) = value {
                    out += &format!("{key} = {}\n", number(value));
                }
            }
        }
        out
    }
}

/// A number without the noise a change of unit leaves in its last digits.
fn number(x: f64) -> String {
    let rounded: f64 = format!("{x:.12e}").parse().unwrap_or(x);
    format!("{rounded:?}")
}

/// A TOML string.
fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}
