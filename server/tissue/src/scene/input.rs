//! A scene together with its surfaces: what a model is built from.

use std::path::Path;

use super::{Scene, SceneError};
use crate::surface::Surface;

/// What the builder takes, whether it came from files or was generated.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneInput {
    /// The scene.
    pub scene: Scene,
    /// One checked surface per region of the scene, in the same order.
    pub surfaces: Vec<Surface>,
    /// What was repaired or looks odd, one sentence each, with the region's name.
    pub warnings: Vec<String>,
}

impl SceneInput {
    /// Reads a scene file and every surface it names, and checks them.
    pub fn load(path: &Path) -> Result<Self, SceneError> {
        let scene = Scene::load(path)?;
        let surfaces = (0..scene.regions.len())
            .map(|r| {
                let path = scene.surface_path(r);
                Surface::read(&path, scene.regions[r].unit)
                    .map_err(|source| SceneError::Surface(scene.regions[r].name.clone(), source))
            })
            .collect::<Result<_, _>>()?;
        Self::new(scene, surfaces)
    }

    /// Checks the surfaces and puts them beside the scene they belong to.
    ///
    /// # Panics
    /// When there is not exactly one surface per region.
    pub fn new(scene: Scene, mut surfaces: Vec<Surface>) -> Result<Self, SceneError> {
        assert_eq!(
            scene.regions.len(),
            surfaces.len(),
            "one surface per region"
        );
        let mut warnings = Vec::new();
        for (r, surface) in surfaces.iter_mut().enumerate() {
            let name = &scene.regions[r].name;
            let report = surface.check().map_err(|source| SceneError::Check {
                region: name.clone(),
                path: scene.surface_path(r),
                source,
            })?;
            let file = scene.regions[r].surface.display();
            warnings.extend(
                report
                    .warnings
                    .iter()
                    .map(|w| format!("{name} ({file}): {w}")),
            );
        }
        Ok(Self {
            scene,
            surfaces,
            warnings,
        })
    }
}
