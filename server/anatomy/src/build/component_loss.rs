//! Components of the input that the model has lost or merged.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::overlap::Component;
use crate::scene::Scene;

/// Most components that a report lists of each kind, the largest first; the rest is counted.
pub const COMPONENTS_MAX: usize = 64;

/// A component is lost when the model's region has less than this part of its volume.
pub const KEPT_MIN: f64 = 0.5;

/// Components below this volume, in mm³, are crumbs: noise of a segmentation.
pub const CRUMB_MM3: f64 = 1.0;

/// A connected component of a region of the input, less what later regions take.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ComponentReport {
    /// The region.
    pub region: String,
    /// Volume in mm³.
    pub volume_mm3: f64,
    /// Part of it that the region of the model has in common.
    pub kept: f64,
    /// A point inside, in mm.
    pub at_mm: [f64; 3],
}

/// A component that is joined with a larger one of its region in the model, and not in the input.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MergedComponent {
    /// The component.
    #[serde(flatten)]
    pub component: ComponentReport,
    /// A point inside the largest component that it is joined with, in mm.
    pub with_mm: [f64; 3],
}

/// Lost and merged components above the volume that the scene sets.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ComponentLoss {
    /// Components of which less than half is in the model's region, the largest first, at most [`COMPONENTS_MAX`].
    pub lost: Vec<ComponentReport>,
    /// Number of further ones.
    pub lost_more: usize,
    /// Merged components, the largest first, at most [`COMPONENTS_MAX`].
    pub merged: Vec<MergedComponent>,
    /// Number of further ones.
    pub merged_more: usize,
}

/// Numbers of components and of crumbs of each region of the input.
pub(super) fn counts(components: &[Component], regions: usize) -> Vec<[usize; 2]> {
    let mut counts = vec![[0; 2]; regions];
    for component in components {
        let is_crumb = component.volume * 1e9 < CRUMB_MM3;
        counts[usize::from(component.region)][usize::from(is_crumb)] += 1;
    }
    counts
}

/// Lists the lost and the merged components from the volume on that the scene sets. Parts of a region that the scene
/// fuses with itself are not listed as merged.
pub(super) fn losses(components: &[Component], names: &[String], scene: &Scene) -> ComponentLoss {
    let mut large: Vec<&Component> = components
        .iter()
        .filter(|c| c.volume * 1e9 >= scene.thresholds.component_mm3)
        .collect();
    // A stable sort: equal volumes keep the order of the rays.
    large.sort_by(|a, b| b.volume.total_cmp(&a.volume));
    let (mut lost, mut merged) = (Vec::new(), Vec::new());
    let mut largest: BTreeMap<u32, &Component> = BTreeMap::new();
    for component in large {
        let report = ComponentReport {
            region: names[usize::from(component.region)].clone(),
            volume_mm3: component.volume * 1e9,
            kept: component.kept,
            at_mm: (component.at * 1e3).into(),
        };
        let Some(within) = component.within.filter(|_| component.kept >= KEPT_MIN) else {
            lost.push(report);
            continue;
        };
        let region = usize::from(component.region);
        if let Some(other) = largest.get(&within) {
            if scene.fuse.contains(&[region; 2]) {
                continue;
            }
            merged.push(MergedComponent {
                component: report,
                with_mm: (other.at * 1e3).into(),
            });
        } else {
            largest.insert(within, component);
        }
    }
    let more = |all: usize| all.saturating_sub(COMPONENTS_MAX);
    let (lost_more, merged_more) = (more(lost.len()), more(merged.len()));
    lost.truncate(COMPONENTS_MAX);
    merged.truncate(COMPONENTS_MAX);
    ComponentLoss {
        lost,
        lost_more,
        merged,
        merged_more,
    }
}

impl std::fmt::Display for ComponentReport {
    /// The component in a warning.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [x, y, z] = self.at_mm;
        write!(
            f,
            "a component of region {:?} of {:.1} mm³ at ({x:.1}, {y:.1}, {z:.1}) mm",
            self.region, self.volume_mm3
        )
    }
}
