//! From a scene to its TOML text.

use std::fmt::{self, Write};

use super::{RegionSource, SCENE_FORMAT, Scene};
use crate::surface::Unit;

impl Scene {
    /// The scene as a TOML text that [`Scene::parse`] reads back as the same scene (up to the
    /// last digit of a converted unit).
    pub fn to_toml(&self) -> String {
        let mut out = String::new();
        self.write(&mut out).expect("a string takes all");
        out
    }

    fn write(&self, out: &mut String) -> fmt::Result {
        writeln!(out, "format = \"{SCENE_FORMAT}\"")?;
        writeln!(out, "spacing_mm = {}", number(self.spacing_m * 1e3))?;
        if !self.pinned.is_empty() {
            let names: Vec<String> = self.pinned.iter().map(|n| quoted(n)).collect();
            writeln!(out, "pinned = [{}]", names.join(", "))?;
        }
        for region in &self.regions {
            writeln!(out, "\n[[region]]\nname = {}", quoted(&region.name))?;
            // Forward slashes are read on every system.
            let file = region.source.file().to_string_lossy().replace('\\', "/");
            match &region.source {
                RegionSource::Surface { unit, .. } => {
                    writeln!(out, "surface = {}", quoted(&file))?;
                    if *unit == Unit::Metre {
                        writeln!(out, "unit = \"m\"")?;
                    }
                }
                RegionSource::Labels { labels, .. } => {
                    writeln!(out, "labels = {}", quoted(&file))?;
                    writeln!(out, "label = {labels:?}")?;
                }
            }
            writeln!(out, "material = {}", quoted(&region.material))?;
        }
        for (name, change) in &self.materials {
            writeln!(out, "\n[material.{}]", quoted(name))?;
            let values = [
                ("young_kpa", change.young_pa.map(|pa| pa * 1e-3)),
                ("density_kg_m3", change.density_kg_m3),
                ("friction_static", change.friction_static),
                ("friction_dynamic", change.friction_dynamic),
            ];
            for (key, value) in values {
                if let Some(value) = value {
                    writeln!(out, "{key} = {}", number(value))?;
                }
            }
        }
        Ok(())
    }
}

/// A number without the noise a change of unit leaves in its last digits.
fn number(x: f64) -> String {
    let rounded: f64 = format!("{x:.12e}").parse().unwrap_or(x);
    format!("{rounded:?}")
}

/// A TOML string on one line, which may also stand where a key must.
fn quoted(text: &str) -> String {
    let mut out = String::from('"');
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if c.is_control() => {
                write!(out, "\\u{:04X}", u32::from(c)).expect("a string takes all");
            }
            c => out.push(c),
        }
    }
    out.push('"');
    out
}
