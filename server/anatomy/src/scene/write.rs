//! From a scene to its TOML text.

use std::fmt::{self, Write};

use palpate_tissue::FibreAxis;
use palpate_tissue::material::MaterialOverride;

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
        let spacing = number(self.spacing_m * 1e3);
        if self.auto_spacing {
            writeln!(out, "spacing_mm = \"auto\"")?;
            if self.spacing_m > 0.0 {
                writeln!(out, "spacing_min_mm = {spacing}")?;
            }
        } else {
            writeln!(out, "spacing_mm = {spacing}")?;
        }
        if !self.pinned.is_empty() {
            let names: Vec<String> = self.pinned.iter().map(|n| quoted(n)).collect();
            writeln!(out, "pinned = [{}]", names.join(", "))?;
        }
        if !self.fuse.is_empty() {
            let name = |r: usize| quoted(&self.regions[r].name);
            let pairs = self.fuse.iter().map(|pair| pair.map(name));
            let pairs: Vec<String> = pairs.map(|[a, b]| format!("[{a}, {b}]")).collect();
            writeln!(out, "fuse = [{}]", pairs.join(", "))?;
        }
        if self.gravity_m_s2 != [0.0; 3] {
            let [x, y, z] = self.gravity_m_s2.map(number);
            writeln!(out, "gravity_m_s2 = [{x}, {y}, {z}]")?;
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
            write_change(out, &region.change)?;
        }
        for (n, (key, value)) in self.thresholds.changed().into_iter().enumerate() {
            let head = if n == 0 { "\n[report]\n" } else { "" };
            writeln!(out, "{head}{key} = {}", number(value))?;
        }
        for (name, change) in &self.materials {
            writeln!(out, "\n[material.{}]", quoted(name))?;
            write_change(out, change)?;
        }
        Ok(())
    }
}

fn write_change(out: &mut String, change: &MaterialOverride) -> fmt::Result {
    for (key, value) in change.numbers() {
        if let Some(value) = value {
            writeln!(out, "{key} = {}", number(value))?;
        }
    }
    if let Some(value) = change.bottoms_out {
        writeln!(out, "bottoms_out = {value}")?;
    }
    match change.fibre_axis {
        None => Ok(()),
        Some(FibreAxis::Long) => writeln!(out, "fibres = \"long\""),
        Some(FibreAxis::Given(axis)) => {
            let [x, y, z] = axis.map(number);
            writeln!(out, "fibres = [{x}, {y}, {z}]")
        }
    }
}

/// A number without the rounding noise of a unit conversion in its last digits.
fn number(x: f64) -> String {
    let rounded: f64 = format!("{x:.12e}").parse().unwrap_or(x);
    format!("{rounded:?}")
}

/// A TOML string on one line, also valid as a key.
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
