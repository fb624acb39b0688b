//! A scene together with its surfaces: the input of the builder.

use std::path::{Path, PathBuf};

use super::{RegionSource, Scene};
use crate::InputError;
use crate::labels::{self, LabelRegion, LabelVolume, Sides, VoxelRuns};
use crate::surface::Surface;

/// Voxels up to this part of the spacing are joined before their surfaces are extracted. Half a spacing is the
/// distance from a node to the nearest other crossing.
const FINEST: f64 = 0.5;

/// Input of the builder, from files or generated.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneInput {
    /// The scene.
    pub scene: Scene,
    /// One closed surface per region of the scene, in the same order, wound outwards.
    pub surfaces: Vec<Surface>,
    /// For each region, the volume in m³ of its own voxels when all regions come from one label volume; `None`
    /// when only its surface defines the volume.
    pub voxels_m3: Vec<Option<f64>>,
    /// The voxels of all regions when all come from one label volume.
    pub voxels: Option<VoxelRuns>,
    /// For each region, the regions on the sides of each triangle of its surface when all regions come from one
    /// label volume. The first surface encloses all, so nothing lies before it. Empty when the builder has to
    /// search for the sides.
    pub sides: Vec<Vec<Sides>>,
    /// Regions whose surface is not wound consistently, so that its inside is ambiguous.
    pub faulty: Vec<usize>,
    /// Repairs and warnings, one sentence each, with the region's name.
    pub warnings: Vec<String>,
}

impl SceneInput {
    /// Reads a scene file and every surface and label volume it names. Surfaces are checked, and those of
    /// labelled regions are extracted.
    pub fn load(path: &Path) -> Result<Self, InputError> {
        let scene = Scene::load(path)?;
        let mut input = Self {
            surfaces: vec![Surface::default(); scene.regions.len()],
            voxels_m3: vec![None; scene.regions.len()],
            voxels: None,
            sides: vec![Vec::new(); scene.regions.len()],
            faulty: Vec::new(),
            warnings: Vec::new(),
            scene,
        };
        for (region, r) in input.scene.regions.iter().enumerate() {
            if let RegionSource::Surface { unit, .. } = r.source {
                let file = input.scene.source_path(region);
                input.surfaces[region] = Surface::read(&file, unit)
                    .map_err(|e| InputError::new(format_args!("region \"{}\": {e}", r.name)))?;
            }
        }
        for volume in label_files(&input.scene) {
            input.extract(&volume)?;
        }
        input.check()?;
        Ok(input)
    }

    /// Checks the surfaces and combines them with their scene.
    ///
    /// # Panics
    /// When there is not exactly one surface per region.
    pub fn new(scene: Scene, surfaces: Vec<Surface>) -> Result<Self, InputError> {
        assert_eq!(
            scene.regions.len(),
            surfaces.len(),
            "one surface per region"
        );
        let mut input = Self {
            voxels_m3: vec![None; surfaces.len()],
            voxels: None,
            sides: vec![Vec::new(); surfaces.len()],
            faulty: Vec::new(),
            warnings: Vec::new(),
            surfaces,
            scene,
        };
        input.check()?;
        Ok(input)
    }

    /// Checks the surfaces from files. Surfaces extracted from labels are closed and wound by construction, so
    /// checking the nesting of their parts would only cost time.
    fn check(&mut self) -> Result<(), InputError> {
        for (r, surface) in self.surfaces.iter_mut().enumerate() {
            let region = &self.scene.regions[r];
            if matches!(region.source, RegionSource::Labels { .. }) {
                continue;
            }
            let report = surface.check().map_err(|e| {
                let (name, path) = (&region.name, self.scene.source_path(r));
                InputError::new(format_args!(
                    "region \"{name}\", surface {}: {e}",
                    path.display()
                ))
            })?;
            if report.unbalanced_edges > 0 {
                self.faulty.push(r);
            }
            let (name, file) = (&region.name, region.source.file().display());
            let say = |w: &String| format!("{name} ({file}): {w}");
            self.warnings.extend(report.warnings.iter().map(say));
        }
        Ok(())
    }

    /// Extracts the surfaces of all regions that come from one label volume.
    fn extract(&mut self, file: &Path) -> Result<(), InputError> {
        let path = self.scene.base.join(file);
        let mut members = Vec::new();
        let mut regions = Vec::new();
        for (r, region) in self.scene.regions.iter().enumerate() {
            match &region.source {
                RegionSource::Labels { file: own, labels } if own == file => {
                    members.push(r);
                    let labels = labels.clone();
                    regions.push(LabelRegion { labels });
                }
                _ => {}
            }
        }
        let volume = LabelVolume::read(&path)?;
        let say = |w: &String| format!("{}: {w}", file.display());
        self.warnings.extend(volume.warnings.iter().map(say));
        let wrap = members.first() == Some(&0);
        let finest_m = self.scene.spacing_m * FINEST;
        let found = labels::surfaces(&volume, &path, &regions, wrap, finest_m)?;
        let alone = members.len() == self.scene.regions.len();
        if alone {
            self.voxels = Some(labels::voxel_runs(&volume, &path, &regions)?);
        }
        for (r, found) in members.into_iter().zip(found) {
            self.surfaces[r] = found.surface;
            if alone {
                self.voxels_m3[r] = Some(found.voxels_m3);
                self.sides[r] = found.sides;
            }
        }
        Ok(())
    }
}

/// The distinct label volumes of a scene, in the order of the regions.
fn label_files(scene: &Scene) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = Vec::new();
    for region in &scene.regions {
        if let RegionSource::Labels { file, .. } = &region.source
            && !files.contains(file)
        {
            files.push(file.clone());
        }
    }
    files
}
