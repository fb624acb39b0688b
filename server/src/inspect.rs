//! `palpate-server inspect`: what a model file holds.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;
use palpate_tissue::{Material, ModelFile, Region, Staged, model_hash};
use serde_json::{Value, json};

use crate::ServerError;
use crate::build::{BuildSummary, describe};
use crate::export::{Exports, put_in_place};
use crate::picture::{self, Slice};

/// A picture of a cross-section, when one is asked for.
#[derive(Debug, Clone, Args)]
pub(crate) struct Picture {
    /// Also draw a cross-section with regions, springs and poor cells
    #[arg(long, value_name = "FILE.png")]
    png: Option<PathBuf>,
    /// Where the picture cuts: x, y or z, with a place in mm [default: z, in the middle]
    #[arg(
        long,
        value_name = "AXIS=MM",
        requires = "png",
        allow_hyphen_values = true
    )]
    slice: Option<Slice>,
    /// Draw the springs however small they come out
    #[arg(long, requires = "png")]
    springs: bool,
}

impl Picture {
    fn stage(&self, file: &ModelFile, path: &Path) -> Result<Option<Staged>, ServerError> {
        let Some(png) = &self.png else {
            return Ok(None);
        };
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let slice = self.slice.unwrap_or_default();
        let bytes = picture::draw(file, &name, slice, self.springs)?;
        Ok(Some(Staged::write(png, |out| out.write_all(&bytes))?))
    }
}

/// The report of a model file: as one JSON object, and for a person. Writes what else is asked for.
pub(crate) fn inspect(
    path: &Path,
    exports: &Exports,
    picture: &Picture,
) -> Result<(Value, String), ServerError> {
    let file = ModelFile::read(path)?;
    let mut staged = exports.stage(&file.model)?;
    staged.extend(picture.stage(&file, path)?);
    put_in_place(staged)?;
    let bytes = std::fs::metadata(path).map_or(0, |m| m.len());
    let hash = format!("{:016x}", model_hash(&file.model));
    let mut value = serde_json::from_str(&file.report_json).unwrap_or_else(|_| json!({}));
    if let Value::Object(map) = &mut value {
        map.insert("model_hash".into(), json!(hash));
        map.insert("file_bytes".into(), json!(bytes));
        map.insert("nodes".into(), json!(file.model.nodes.len()));
        map.insert("cells".into(), json!(file.model.cells.len()));
        map.insert("materials".into(), materials(&file));
    }
    let mut text = match serde_json::from_str::<BuildSummary>(&file.report_json) {
        Ok(summary) => describe(&summary),
        Err(_) => format!(
            "{} nodes, {} cells; the file carries no build report",
            file.model.nodes.len(),
            file.model.cells.len()
        ),
    };
    // Writing to a string does not fail.
    let _ = write!(text, "\nmodel {hash}, {:.2} MB", bytes as f64 / 1e6);
    for region in &file.model.regions {
        let m = &region.material;
        let _ = write!(
            text,
            "\n{:<24} {:<12} {:>11.2} kPa, Poisson {:.2}, {:>6.0} kg/m3{}{}  ({})",
            region.name,
            m.name,
            m.young_pa / 1e3,
            m.poisson,
            m.density_kg_m3,
            special(region),
            if region.pinned { ", pinned" } else { "" },
            m.source
        );
    }
    Ok((value, text))
}

/// What is out of the common about a region's material.
fn special(region: &Region) -> String {
    let m = &region.material;
    let plain = Material::default();
    let mut text = String::new();
    if m.stiffening != plain.stiffening {
        let _ = write!(text, ", stiffening {}", m.stiffening);
    }
    if m.fibre_ratio != plain.fibre_ratio {
        let [x, y, z] = region.fibre;
        let _ = write!(
            text,
            ", {} times as stiff along [{x:.3}, {y:.3}, {z:.3}]",
            m.fibre_ratio
        );
    }
    if [m.compress_limit, m.stretch_limit] != [plain.compress_limit, plain.stretch_limit] {
        let _ = write!(
            text,
            ", springs of {} to {} rest lengths",
            m.compress_limit, m.stretch_limit
        );
    }
    text
}

fn materials(file: &ModelFile) -> Value {
    file.model
        .regions
        .iter()
        .map(|r| {
            json!({
                "region": r.name,
                "material": r.material.name,
                "young_kpa": r.material.young_pa / 1e3,
                "poisson": r.material.poisson,
                "stiffening": r.material.stiffening,
                "fibre_ratio": r.material.fibre_ratio,
                "fibre": r.fibre,
                "compress_limit": r.material.compress_limit,
                "stretch_limit": r.material.stretch_limit,
                "density_kg_m3": r.material.density_kg_m3,
                "friction_static": r.material.friction_static,
                "friction_dynamic": r.material.friction_dynamic,
                "pinned": r.pinned,
                "source": r.material.source,
            })
        })
        .collect()
}
