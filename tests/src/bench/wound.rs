//! A wound beside the press: the cut of the demo, but through every layer down to half of the soft tissue.

use palpate_tissue::{BladePoint, CutStroke, Topology, cut};
use serde::Serialize;

use crate::tool_location::ToolLocation;

/// Maximum length of the wound, m: that of the demo stroke.
const LENGTH_M: f64 = 0.050;
/// Maximum depth, m: through skin and fat into the muscle of a thigh.
const DEPTH_MAX_M: f64 = 0.030;
/// Depth as a share of the soft tissue.
const DEPTH_SHARE: f64 = 0.5;
/// Blade length outside the tissue, m.
const OUTSIDE_M: f64 = 0.006;
/// Maximum distance of the press from the wound, m.
const BESIDE_M: f64 = 0.012;
/// Width of the wound at its top, m: that of a scalpel.
const WIDTH_M: f64 = 0.5e-3;
const POINTS: usize = 50;

#[derive(Debug, Clone, Serialize)]
pub struct Wound {
    pub depth_mm: f64,
    pub doubled: usize,
    pub regions: Vec<String>,
}

impl Wound {
    /// Cuts through the centre of a location along its stroke, and moves the location beside the wound.
    /// Also returns the stroke.
    pub fn open(
        topology: &mut Topology,
        location: &mut ToolLocation,
    ) -> Result<(Self, CutStroke), String> {
        let depth = (DEPTH_SHARE * location.depth_m).min(DEPTH_MAX_M);
        let length = (LENGTH_M * location.scale()).max(5.0 * location.spacing_m);
        let points = (0..=POINTS).map(|i| {
            let along = (i as f64 / POINTS as f64 - 0.5) * length;
            BladePoint {
                tip: location.surface(0.0, along).at - location.normal * depth,
                axis: location.normal,
                depth_m: depth + OUTSIDE_M,
            }
        });
        let stroke = CutStroke {
            points: points.collect(),
            width_m: WIDTH_M,
        };
        let beside = (BESIDE_M * location.scale()).max(2.0 * location.spacing_m);
        let spot = location.spot(beside, 0.0, beside / 2.0);
        let outcome = cut(topology, &stroke).map_err(|e| format!("no wound: {e}"))?;
        (location.middle, location.normal) = (spot.at, spot.normal);
        let regions = &topology.model().regions;
        let name = |id: &palpate_tissue::RegionId| regions[id.index()].name.clone();
        let wound = Self {
            depth_mm: depth * 1e3,
            doubled: outcome.doubled.len(),
            regions: outcome.regions_cut.iter().map(name).collect(),
        };
        Ok((wound, stroke))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use palpate_anatomy::build;
    use palpate_anatomy::sample::Sample;
    use palpate_tissue::Topology;

    use super::Wound;
    use crate::tool_location::ToolLocation;

    #[test]
    fn thigh_wound_reaches_the_muscle_and_the_press_is_beside_it() {
        let input = Sample::Thigh.input().unwrap();
        let (model, _) = build(&input, &mut |_, _| ()).unwrap();
        let mut topology = Topology::new(Arc::new(model));
        let mut location = ToolLocation::find(&topology).unwrap();
        let middle = location.middle;
        let (wound, _) = Wound::open(&mut topology, &mut location).unwrap();
        assert!(wound.doubled > 50, "{wound:?}");
        assert!(wound.regions.len() >= 2, "{wound:?}");
        assert!((location.middle - middle).norm() > 0.008);
    }
}
