//! A specimen under load: a model, prescribed displacements, its equilibrium and reactions.

use std::path::PathBuf;
use std::sync::Arc;

use palpate_anatomy::{
    RegionSource, Scene, SceneInput, SceneRegion, Surface, Thresholds, Unit, build,
};
use palpate_tissue::material::MaterialOverride;
use palpate_tissue::{Budget, Material, Model, Shape, Tissue, Tool, Vec3};

pub(super) const YOUNG_PA: f64 = 10e3;
/// Relative residual of a solve: 0.1 % of error in a slender beam. Rounding leaves 1e-5.
const TOLERANCE: f64 = 5e-5;
const ITERATIONS: usize = 500;
/// Residual up to which a solve counts.
const SOLVED: f64 = 2e-4;

pub(super) fn material(poisson: f64) -> Material {
    Material {
        young_pa: YOUNG_PA,
        poisson,
        ..Material::default()
    }
}

/// Shear modulus in Pa.
pub(super) fn shear_pa(poisson: f64) -> f64 {
    YOUNG_PA / (2.0 * (1.0 + poisson))
}

/// A model that the public build makes of closed surfaces, each with its Young's modulus in Pa.
pub(super) fn built(
    parts: Vec<(Surface, f64)>,
    poisson: f64,
    spacing_m: f64,
) -> Result<Model, String> {
    let region = |i: usize| SceneRegion {
        name: format!("part{i}"),
        source: RegionSource::Surface {
            file: PathBuf::new(),
            unit: Unit::Metre,
        },
        material: format!("material{i}"),
        change: MaterialOverride::default(),
    };
    let own = |(i, part): (usize, &(Surface, f64))| {
        let change = MaterialOverride {
            young_pa: Some(part.1),
            poisson: Some(poisson),
            density_kg_m3: Some(1000.0),
            ..MaterialOverride::default()
        };
        (format!("material{i}"), change)
    };
    let scene = Scene {
        spacing_m,
        regions: (0..parts.len()).map(region).collect(),
        materials: parts.iter().enumerate().map(own).collect(),
        auto_spacing: false,
        thresholds: Thresholds::default(),
        pinned: Vec::new(),
        fuse: Vec::new(),
        gravity_m_s2: [0.0; 3],
        base: PathBuf::new(),
    };
    let surfaces = parts.into_iter().map(|part| part.0).collect();
    let input = SceneInput::new(scene, surfaces).map_err(|e| e.to_string())?;
    let (model, _) = build(&input, &mut |_, _| ()).map_err(|e| e.to_string())?;
    Ok(model)
}

pub(super) struct Specimen {
    pub(super) tissue: Tissue,
}

impl Specimen {
    pub(super) fn new(model: Model) -> Self {
        Self {
            tissue: Tissue::new(Arc::new(model)),
        }
    }

    pub(super) fn spacing_m(&self) -> f64 {
        self.tissue.model().spacing_m
    }

    /// Numbers and rest positions of the nodes.
    pub(super) fn nodes(&self) -> impl Iterator<Item = (u32, Vec3)> + use<> {
        let topology = Arc::clone(self.tissue.topology());
        (0..topology.node_count() as u32).map(move |node| (node, topology.rest(node)))
    }

    pub(super) fn displacement(&self, node: u32) -> Vec3 {
        let shape: &Shape = self.tissue.shape();
        shape.displacement[node as usize]
    }

    /// Holds the nodes for which there is a displacement, by rest position.
    pub(super) fn hold(
        &mut self,
        displacement: impl Fn(u32, Vec3) -> Option<Vec3>,
    ) -> Result<(), String> {
        for (node, at) in self.nodes() {
            let by = displacement(node, at);
            if by.is_some_and(|by| !self.tissue.hold(node, by)) {
                return Err(format!("node {node} cannot be held: too many nodes"));
            }
        }
        Ok(())
    }

    pub(super) fn solve(&mut self, tools: &[Tool]) {
        self.tissue.step(tools, Budget::new(ITERATIONS, TOLERANCE));
    }

    pub(super) fn is_converged(&self) -> bool {
        self.tissue.report().residual <= SOLVED
    }

    /// The sum over nodes of forces that hold them, each by its share: a force, a moment or a work.
    pub(super) fn reaction(&self, share: impl Fn(u32, Vec3) -> Option<Vec3>) -> f64 {
        let of = |(node, at)| {
            let share = share(node, at)?;
            // The springs pull against the force that holds the node.
            Some(-self.tissue.force_on(node).dot(&share))
        };
        self.nodes().filter_map(of).sum()
    }
}
