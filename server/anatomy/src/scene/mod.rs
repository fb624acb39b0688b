//! Scenes: the surfaces of a model, the material of each, and the lattice spacing.
//!
//! The file format is `palpate-scene/1`, in TOML:
//!
//! ```toml
//! format = "palpate-scene/1"
//! spacing_mm = 4.0                 # or "auto": as thin as the thinnest layers,
//!                                  # but not below spacing_min_mm, if that is given
//! pinned = ["femur"]               # regions that do not move
//! fuse = [["femur", "tibia"]]      # optional: regions that grow together where they are nearer than a cell;
//!                                  # others stay apart where they are an eighth of the spacing or more apart
//! gravity_m_s2 = [0.0, 0.0, -9.81] # optional; without it nothing weighs anything
//!
//! [[region]]                       # later regions override earlier ones where they overlap
//! name = "subcutaneous"
//! surface = "thigh_skin.stl"       # relative to the scene file; millimetres unless unit = "m"
//! material = "fat"
//! [[region]]
//! name = "femur"
//! surface = "thigh_femur.stl"
//! material = "bone"
//!
//! poisson = 0.3                    # any key of a material: for this region alone
//!
//! [report]                         # optional: deviations from the input that the build warns of, here the defaults
//! dice = 0.9                       # Dice coefficient of a region, at least
//! volume_percent = 1.0             # error of its volume
//! distance_mm = 8.0                # between its surfaces in model and input; two spacings unless given
//! contact_mm2 = 10.0               # contact area of two regions that was created or removed
//! component_mm3 = 1.0              # lost or merged components, from this volume on
//! self_intersections = 0           # pairs of triangles of surfaces that pass through each other
//!
//! [material.fat]                   # optional: changes a built-in material or adds a new one
//! young_kpa = 10.0
//! ```
//!
//! Regions may come from a label volume instead, some or all of them:
//!
//! ```toml
//! labels = "thigh.nii.gz"          # relative to the scene file; a region may name another one
//!
//! [[region]]
//! name = "muscle"
//! label = [2, 5]                   # or one number; a label of several regions is the last one's
//! material = "muscle"
//! ```
//!
//! When the first region comes from labels, its surface encloses all regions of the same volume. Later regions
//! override it, so every voxel belongs to the region of its label.
//!
//! Keys of a material, in `[material.NAME]` and in `[[region]]` alike. Keys missing in a region default to its
//! `[material.NAME]`, then to the library. A material that is not built in needs a `[material.NAME]` with
//! `young_kpa` and `density_kg_m3`.
//!
//! | key | meaning | bounds | new material |
//! | --- | --- | --- | --- |
//! | `young_kpa` | Young's modulus in kPa; with fibres, across them | 0.001 to 2e9 | needed |
//! | `poisson` | Poisson's ratio; a quarter is springs alone, soft tissue has 0.45 | 0.25 to 0.49 | 0.25 |
//! | `stiffening` | b of the spring curve F = k l0 (exp(b e) - 1)/b over the strain e; 0 is a line | 0 to 50 | 0 |
//! | `fibre_ratio` | Young's modulus along the fibres over the one across | 0.1 to 20 | 1 |
//! | `fibres` | their direction: `"long"` (the region's long axis) or `[x, y, z]` | | `"long"` |
//! | `compress_limit` | least spring length, relative to its rest length | 0.05 to 0.95 | 0.3 |
//! | `stretch_limit` | greatest spring length, relative to its rest length | 1.01 to 100 | 3 |
//! | `bottoms_out` | hardens when pressed flat, no folds; without it steps take 20 % less time | `true`, `false` | `true` |
//! | `density_kg_m3` | density in kg/m³ | 1 to 25 000 | needed |
//! | `friction_static` | coefficient of static friction against a tool | 0 to 5 | 0.4 |
//! | `friction_dynamic` | of dynamic friction; not above the static one | 0 to 5 | 0.3 |
//! | `toughness_j_m2` | fracture toughness against a sharp blade or needle in J/m²; from 5000 on no needle enters | 0 to 1e5 | 200 |

mod input;
mod keys;
mod materials;
mod parse;
mod source;
mod thresholds;
mod write;

pub use input::SceneInput;
pub use source::RegionSource;
pub use thresholds::Thresholds;

use std::collections::BTreeMap;
use std::path::PathBuf;

use palpate_tissue::material::MaterialOverride;
use palpate_tissue::{Material, Region};

use crate::InputError;

/// The one format this version reads and writes.
pub const SCENE_FORMAT: &str = "palpate-scene/1";

/// Most regions in one scene. Reason: the builder resolves overlaps along a ray in the bits of one 64-bit word,
/// and each region costs one ray pass over its surface. Beyond the bound the scene is rejected.
pub const REGIONS_MAX: usize = 64;

/// Largest scene file in bytes. Reason: a scene of [`REGIONS_MAX`] regions is some 50 kB; a larger file is of
/// another type. Beyond the bound it is rejected unread.
pub const SCENE_BYTES_MAX: u64 = 1 << 20;

/// Largest gravity of a scene in m/s², per axis. Reason: ten times that of the Earth is a centrifuge; more is a
/// wrong unit (mm/s²). Beyond the bound the scene is rejected.
pub const GRAVITY_MAX_M_S2: f64 = 100.0;

/// One region of a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneRegion {
    /// Its name, unique in the scene.
    pub name: String,
    /// Source of its shape.
    pub source: RegionSource,
    /// Name of its material: built in, or from `[material.NAME]`.
    pub material: String,
    /// Material changes for this region.
    pub change: MaterialOverride,
}

/// Content of a scene file, checked: names are unique, materials and pinned regions exist, numbers are in
/// range. Surfaces are not checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Lattice spacing Δd in m; with `auto_spacing` the least one, `d_threshold`, 0 for none.
    pub spacing_m: f64,
    /// The builder finds the spacing from the thinnest layers (Lin 2007, eq. 3.2).
    pub auto_spacing: bool,
    /// Names of the regions that do not move.
    pub pinned: Vec<String>,
    /// Pairs of regions, the earlier one first, whose cells are joined where no cell is empty between them. A region
    /// paired with itself joins its own parts.
    pub fuse: Vec<[usize; 2]>,
    /// Acceleration of gravity in m/s² along the axes of the model; zeros for none. Surfaces and labels define
    /// the shape without gravity.
    pub gravity_m_s2: [f64; 3],
    /// In scene order: a later region overrides an earlier one where they overlap.
    pub regions: Vec<SceneRegion>,
    /// `[report]` table: deviations from which the build report warns.
    pub thresholds: Thresholds,
    /// `[material.NAME]` tables: changes to built-in materials, and new ones.
    pub materials: BTreeMap<String, MaterialOverride>,
    /// The folder that paths of surfaces and label volumes are relative to.
    pub base: PathBuf,
}

impl Scene {
    /// Path of the file that defines a region's shape: a surface or a label volume.
    pub fn source_path(&self, region: usize) -> PathBuf {
        self.base.join(self.regions[region].source.file())
    }

    /// The material a region is filled with, overrides applied.
    pub fn material(&self, region: usize) -> Result<Material, InputError> {
        let SceneRegion {
            material: name,
            change,
            ..
        } = &self.regions[region];
        let material = Material::resolve(name, self.materials.get(name))?;
        Ok(material.with(change, "changed for this region")?)
    }

    /// The regions of a [`palpate_tissue::Model`], before it has cells to compute fibre directions from; see
    /// [`palpate_tissue::Model::resolve_fibres`].
    pub fn model_regions(&self) -> Result<Vec<Region>, InputError> {
        (0..self.regions.len())
            .map(|r| {
                let name = self.regions[r].name.clone();
                let pinned = self.pinned.contains(&name);
                Ok(Region {
                    material: self.material(r)?,
                    name,
                    pinned,
                    fibre: [0.0; 3],
                })
            })
            .collect()
    }
}
