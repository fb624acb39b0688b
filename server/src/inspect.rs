//! `palpate-server inspect`: contents of a model file or a label volume.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;
use palpate_anatomy::LabelVolume;
use palpate_tissue::file::{ModelFile, Staged};
use palpate_tissue::snapshot::model_hash;
use palpate_tissue::{Material, Region};
use serde_json::{Value, json};

use crate::ServerError;
use crate::build::{BuildSummary, describe};
use crate::export::{Exports, keep_apart, put_in_place};
use crate::picture::{self, Slice};

/// Options of the cross-section.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct Picture {
    /// Also draw a cross-section with regions, springs and poor cells
    #[arg(long, value_name = "FILE.png")]
    png: Option<PathBuf>,
    /// Plane of the cross-section: x, y or z, optionally with a position in mm [default: z, in the middle]
    #[arg(
        long,
        value_name = "AXIS=MM",
        requires = "png",
        allow_hyphen_values = true
    )]
    slice: Option<Slice>,
    /// Draw the springs at any scale
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

/// Contents of a file as a JSON object and as text. Also writes the requested exports and picture, for models only.
/// A file without the extension of a model is read as a label volume.
pub(crate) fn inspect(
    path: &Path,
    exports: &Exports,
    picture: &Picture,
) -> Result<(Value, String), ServerError> {
    const VOLUMES: [&str; 6] = ["nii", "gz", "nrrd", "nhdr", "dcm", "dicom"];
    let extension = path.extension().unwrap_or_default().to_string_lossy();
    if path.is_dir() || VOLUMES.contains(&extension.to_lowercase().as_str()) {
        if exports.any() || picture.png.is_some() {
            return Err(ServerError::Option(format!(
                "{} is a label volume: --vtu, --stl and --png show a model; build one from it first",
                path.display()
            )));
        }
        return inspect_labels(path);
    }
    inspect_model(path, exports, picture)
}

fn inspect_labels(path: &Path) -> Result<(Value, String), ServerError> {
    let volume = LabelVolume::read(path)?;
    let [nx, ny, nz] = volume.size;
    let [dx, dy, dz] = volume.to_world.spacing_m().map(|d| d * 1e3);
    let bounds = volume.world_bounds();
    let mm = |p: &palpate_tissue::Vec3| [p.x * 1e3, p.y * 1e3, p.z * 1e3];
    let (low, high) = (mm(&bounds.min), mm(&bounds.max));
    let labels: Vec<(u16, u64, f64)> = volume
        .counts()
        .into_iter()
        .map(|(label, voxels)| (label, voxels, voxels as f64 * volume.voxel_m3() * 1e3))
        .collect();
    let linear = &volume.to_world.linear;
    let origin = &volume.to_world.origin;
    let affine: Vec<[f64; 4]> = (0..3)
        .map(|r| [linear[(r, 0)], linear[(r, 1)], linear[(r, 2)], origin[r]].map(|x| x * 1e3))
        .collect();
    let value = json!({
        "size": volume.size,
        "spacing_mm": [dx, dy, dz],
        "world": "RAS",
        "affine_mm": affine,
        "world_min_mm": low,
        "world_max_mm": high,
        "labels": labels.iter().map(|(label, voxels, litres)| {
            json!({ "label": label, "voxels": voxels, "litres": litres })
        }).collect::<Vec<_>>(),
        "warnings": volume.warnings,
    });
    let mut text = format!(
        "{nx} x {ny} x {nz} voxels of {dx:.3} x {dy:.3} x {dz:.3} mm\n\
         world (RAS, mm): x {:.1} .. {:.1}, y {:.1} .. {:.1}, z {:.1} .. {:.1}\n{:>6} {:>12} {:>10}",
        low[0], high[0], low[1], high[1], low[2], high[2], "label", "voxels", "litres"
    );
    for (label, voxels, litres) in &labels {
        let _ = write!(text, "\n{label:>6} {voxels:>12} {litres:>10.4}");
    }
    for warning in &volume.warnings {
        let _ = write!(text, "\nwarning: {warning}");
    }
    Ok((value, text))
}

fn inspect_model(
    path: &Path,
    exports: &Exports,
    picture: &Picture,
) -> Result<(Value, String), ServerError> {
    let file = ModelFile::read(path)?;
    let places: Vec<&Path> = exports.files().chain(picture.png.as_deref()).collect();
    keep_apart(&places, &[path])?;
    let mut staged = exports.stage(&file.model)?;
    staged.extend(picture.stage(&file, path)?);
    put_in_place(staged, &[path])?;
    let bytes = std::fs::metadata(path).map_or(0, |m| m.len());
    let hash = format!("{:016x}", model_hash(&file.model));
    let mut value = serde_json::from_str(&file.report_json).unwrap_or_else(|_| json!({}));
    if let Value::Object(map) = &mut value {
        map.insert("model_hash".into(), json!(hash));
        map.insert("file_bytes".into(), json!(bytes));
        map.insert("nodes".into(), json!(file.model.nodes.len()));
        map.insert("cells".into(), json!(file.model.cells.len()));
        map.insert("gravity_m_s2".into(), json!(file.model.gravity));
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
    for cut in value["cuts"].as_array().into_iter().flatten() {
        let _ = write!(
            text,
            "\ncut: {} of {} strokes applied, {} component(s) afterwards, topology {}",
            cut["applied"],
            cut["operations"],
            cut["components"].as_array().map_or(0, Vec::len),
            cut["topology_hash"].as_str().unwrap_or_default()
        );
    }
    if file.model.gravity != [0.0; 3] {
        let [x, y, z] = file.model.gravity;
        let _ = write!(text, "\ngravity [{x}, {y}, {z}] m/s2");
    }
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

/// The material properties of a region that differ from the default.
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
    if !m.bottoms_out {
        text.push_str(", does not bottom out");
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
                "bottoms_out": r.material.bottoms_out,
                "density_kg_m3": r.material.density_kg_m3,
                "friction_static": r.material.friction_static,
                "friction_dynamic": r.material.friction_dynamic,
                "toughness_j_m2": r.material.toughness_j_m2,
                "pinned": r.pinned,
                "source": r.material.source,
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn label_volume_is_recognised_by_name_and_its_labels_are_listed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.nrrd");
        let text = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: ascii\n\
                    space: LPS\nspace directions: (10,0,0) (0,10,0) (0,0,20)\n\
                    space origin: (5,5,0)\n\n0 0 0 7 7 7 0 0";
        std::fs::write(&path, text).unwrap();
        let (exports, picture) = Default::default();
        let (value, text) = inspect(&path, &exports, &picture).unwrap();
        assert_eq!(value["size"], json!([2, 2, 2]));
        assert_eq!(value["labels"][1]["voxels"], 3);
        let litres = value["labels"][1]["litres"].as_f64().unwrap();
        assert!((litres - 0.006).abs() < 1e-9);
        // LPS in the file, RAS in the world.
        assert!((value["world_min_mm"][0].as_f64().unwrap() + 20.0).abs() < 1e-9);
        assert!(text.contains("10.000 x 10.000 x 20.000 mm") && text.contains("0.0060"));
        let png = dir.path().join("a.png");
        let picture = Picture {
            png: Some(png.clone()),
            ..Picture::default()
        };
        let error = inspect(&path, &exports, &picture).unwrap_err();
        assert!(matches!(error, ServerError::Option(_)), "{error}");
        assert!(!png.exists());
    }

    #[test]
    fn file_that_is_neither_model_nor_label_volume_is_rejected() {
        let dir = tempfile::tempdir().unwrap();
        let refusal = |name: &str| {
            let path = dir.path().join(name);
            std::fs::write(&path, b"nothing of the kind").unwrap();
            inspect(&path, &Exports::default(), &Picture::default()).unwrap_err()
        };
        for name in ["a.nii", "a.nii.gz", "a.nrrd"] {
            let error = refusal(name);
            assert!(matches!(error, ServerError::Input(_)), "{error}");
            assert!(error.to_string().contains(name), "{error}");
        }
        for name in ["a.palp", "a.txt"] {
            let error = refusal(name);
            assert!(matches!(error, ServerError::File(_)), "{error}");
        }
    }
}
