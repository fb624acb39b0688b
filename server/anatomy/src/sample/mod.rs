//! Built-in samples: closed surfaces that the program generates, so that it ships no third-party data.
//!
//! The shapes follow common anatomical proportions, smooth and simple. They are for trying the program and for
//! tests, not for measuring a person. Layers thinner than the lattice spacing cannot be divided. Where real
//! skin (1 to 3 mm) is thinner, the outermost region combines skin and fat, and the sample documents it.

mod abdominal_wall;
mod handle;
mod leg;
mod loft;
mod slab;
mod thigh;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use palpate_tissue::file::write_file;
use palpate_tissue::material::{MaterialOverride, nearest_name};

use crate::InputError;
use crate::scene::{RegionSource, Scene, SceneInput, SceneRegion, Thresholds};
use crate::surface::{Surface, Unit};

/// A built-in sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Sample {
    /// A segment of a right thigh: subcutaneous tissue (with the skin), three muscle groups,
    /// femur and marrow. 4 mm, some 50 000 nodes.
    Thigh,
    /// A block of the anterior abdominal wall: skin, fat, rectus sheath, the two rectus muscles,
    /// peritoneum (Lin 2007, fig. 3.1). 3 mm.
    AbdominalWall,
    /// A right lower leg: subcutaneous tissue (with the skin), two muscle groups, tibia and
    /// fibula. 4 mm.
    Leg,
    /// A product: a soft grip with finger grooves around a hard core (Lin 2007, fig. 7.2). 2 mm.
    Handle,
}

/// A generated scene with its surfaces, before it is written or built.
#[derive(Debug, Clone, PartialEq)]
pub struct SampleFiles {
    /// File name of the scene.
    pub scene_file: String,
    /// The scene; its surfaces are named as in `surfaces`.
    pub scene: Scene,
    /// File name and surface of each region, in scene order.
    pub surfaces: Vec<(String, Surface)>,
}

/// Contacts of fewer cell faces than this, and components smaller than a cell, are below the resolution of a sample: its
/// report does not warn of them.
const FACES_MIN: f64 = 5.0;

fn thresholds(spacing_m: f64) -> Thresholds {
    let spacing_mm = spacing_m * 1e3;
    Thresholds {
        contact_mm2: FACES_MIN * spacing_mm.powi(2),
        component_mm3: spacing_mm.powi(3),
        ..Thresholds::default()
    }
}

impl Sample {
    /// All samples, in listing order.
    pub const ALL: [Self; 4] = [Self::Thigh, Self::AbdominalWall, Self::Leg, Self::Handle];

    /// Its name on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Thigh => "thigh",
            Self::AbdominalWall => "abdominal-wall",
            Self::Leg => "leg",
            Self::Handle => "handle",
        }
    }

    /// Generates the scene and its surfaces. The result is always bit-identical.
    pub fn generate(self) -> SampleFiles {
        let body = match self {
            Self::Thigh => thigh::body(),
            Self::AbdominalWall => abdominal_wall::body(),
            Self::Leg => leg::body(),
            Self::Handle => handle::body(),
        };
        let file = |part: &str| format!("{}_{part}.stl", self.name().replace('-', "_"));
        let regions = body.parts.iter().map(|part| SceneRegion {
            name: part.name.to_owned(),
            source: RegionSource::Surface {
                file: file(part.name).into(),
                unit: Unit::Millimetre,
            },
            material: part.material.to_owned(),
            change: MaterialOverride::default(),
        });
        let scene = Scene {
            spacing_m: body.spacing_m,
            auto_spacing: false,
            thresholds: thresholds(body.spacing_m),
            fuse: Vec::new(),
            pinned: body.pinned.iter().map(|&name| name.to_owned()).collect(),
            gravity_m_s2: [0.0; 3],
            regions: regions.collect(),
            materials: BTreeMap::new(),
            base: PathBuf::new(),
        };
        let surfaces = body
            .parts
            .into_iter()
            .map(|p| (file(p.name), p.surface))
            .collect();
        SampleFiles {
            scene_file: format!("{}.toml", self.name()),
            scene,
            surfaces,
        }
    }

    /// Generates the input of the builder, without files.
    pub fn input(self) -> Result<SceneInput, InputError> {
        let files = self.generate();
        SceneInput::new(
            files.scene,
            files.surfaces.into_iter().map(|(_, s)| s).collect(),
        )
    }
}

impl FromStr for Sample {
    type Err = InputError;

    fn from_str(name: &str) -> Result<Self, InputError> {
        Self::ALL
            .into_iter()
            .find(|s| s.name() == name)
            .ok_or_else(|| {
                let names = Self::ALL.map(Self::name);
                let nearest = nearest_name(name, names);
                let hint = nearest.map(|n| format!(", did you mean \"{n}\"?"));
                InputError::new(format_args!(
                    "no sample \"{name}\"{}; samples are {}",
                    hint.unwrap_or_default(),
                    names.join(", ")
                ))
            })
    }
}

impl std::fmt::Display for Sample {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl SampleFiles {
    /// Writes the scene and its surfaces (binary STL in millimetres) into `dir`, which is made if it does not
    /// exist. Without `overwrite`, nothing is written if one of the files exists. Returns the scene file.
    pub fn write(&self, dir: &Path, overwrite: bool) -> Result<PathBuf, InputError> {
        std::fs::create_dir_all(dir).map_err(|e| {
            InputError::of(
                dir,
                format_args!("{e}; check that the folder can be written"),
            )
        })?;
        let scene = dir.join(&self.scene_file);
        if !overwrite {
            let names = self.surfaces.iter().map(|(name, _)| dir.join(name));
            if let Some(path) = std::iter::once(scene.clone())
                .chain(names)
                .find(|p| p.symlink_metadata().is_ok())
            {
                return Err(InputError::new(format_args!(
                    "{} exists already; choose another folder, or allow overwriting",
                    path.display()
                )));
            }
        }
        for (name, surface) in &self.surfaces {
            surface.write_stl(&dir.join(name))?;
        }
        // The scene is written last, so that an existing scene is complete.
        write_file(&scene, self.scene.to_toml())?;
        Ok(scene)
    }
}

/// Description of a sample.
struct Body {
    spacing_m: f64,
    pinned: &'static [&'static str],
    /// In scene order: a later one overrides an earlier one.
    parts: Vec<Part>,
}

/// One region.
struct Part {
    name: &'static str,
    material: &'static str,
    surface: Surface,
}
