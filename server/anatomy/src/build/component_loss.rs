//! Components of the input that the model has lost or merged.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::components::{Component, Piece};
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
    /// For a piece of a component that the model has kept, the volume of that component in mm³: necks thinner than a third
    /// of a spacing join it to the rest.
    #[serde(default)]
    pub piece_of_mm3: Option<f64>,
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
    /// Components, and pieces of kept ones, of which less than half is in the model's region; the largest first, at most
    /// [`COMPONENTS_MAX`].
    pub lost: Vec<ComponentReport>,
    /// Number of further ones.
    pub lost_more: usize,
    /// Merged components, the largest first, at most [`COMPONENTS_MAX`].
    pub merged: Vec<MergedComponent>,
    /// Number of further ones.
    pub merged_more: usize,
    /// Regions whose lost crumbs add up to the volume that the scene sets.
    #[serde(default)]
    pub crumbs: Vec<LostCrumbs>,
}

/// Lost components of a region below [`CRUMB_MM3`] each. They may be noise, or a sheet that is too thin for the rays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LostCrumbs {
    /// The region.
    pub region: String,
    /// Their number.
    pub count: usize,
    /// Their volume in mm³, together.
    pub volume_mm3: f64,
}

/// Components of one region of the input.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Counts {
    /// Components that are no crumbs.
    pub(super) components: usize,
    pub(super) crumbs: usize,
    /// Crumbs that are not lost.
    pub(super) crumbs_kept: usize,
    /// Volume of those that are, in m³.
    pub(super) crumbs_lost: f64,
}

/// Counts the components of each region of the input.
pub(super) fn counts(components: &[Component], regions: usize) -> Vec<Counts> {
    let mut counts = vec![Counts::default(); regions];
    for Component { whole, .. } in components {
        let own = &mut counts[usize::from(whole.region)];
        let is_crumb = whole.volume * 1e9 < CRUMB_MM3;
        own.components += usize::from(!is_crumb);
        own.crumbs += usize::from(is_crumb);
        if is_crumb && whole.kept >= KEPT_MIN {
            own.crumbs_kept += 1;
        } else if is_crumb {
            own.crumbs_lost += whole.volume;
        }
    }
    counts
}

/// Lists the lost and the merged components from the volume on that the scene sets. Parts of a region that the scene
/// fuses with itself are not listed as merged.
pub(super) fn losses(components: &[Component], names: &[String], scene: &Scene) -> ComponentLoss {
    let is_large = |piece: &Piece| piece.volume * 1e9 >= scene.thresholds.component_mm3;
    let mut large: Vec<&Component> = components.iter().filter(|c| is_large(&c.whole)).collect();
    // A stable sort: equal volumes keep the order of the rays.
    large.sort_by(|a, b| b.whole.volume.total_cmp(&a.whole.volume));
    let report = |piece: &Piece, whole: Option<&Piece>| ComponentReport {
        region: names[usize::from(piece.region)].clone(),
        volume_mm3: piece.volume * 1e9,
        kept: piece.kept,
        at_mm: (piece.at * 1e3).into(),
        piece_of_mm3: whole.map(|whole| whole.volume * 1e9),
    };
    let (mut lost, mut merged) = (Vec::new(), Vec::new());
    let mut largest: BTreeMap<u32, &Piece> = BTreeMap::new();
    for component in large {
        let whole = &component.whole;
        let Some(within) = whole.within.filter(|_| whole.kept >= KEPT_MIN) else {
            lost.push(report(whole, None));
            continue;
        };
        let pieces = component.pieces.iter();
        let pieces = pieces.filter(|p| is_large(p) && p.kept < KEPT_MIN);
        lost.extend(pieces.map(|p| report(p, Some(whole))));
        let region = usize::from(whole.region);
        if let Some(other) = largest.get(&within) {
            if scene.fuse.contains(&[region; 2]) {
                continue;
            }
            merged.push(MergedComponent {
                component: report(whole, None),
                with_mm: (other.at * 1e3).into(),
            });
        } else {
            largest.insert(within, whole);
        }
    }
    lost.sort_by(|a, b| b.volume_mm3.total_cmp(&a.volume_mm3));
    let more = |all: usize| all.saturating_sub(COMPONENTS_MAX);
    let (lost_more, merged_more) = (more(lost.len()), more(merged.len()));
    lost.truncate(COMPONENTS_MAX);
    merged.truncate(COMPONENTS_MAX);
    let crumbs = counts(components, names.len()).into_iter().zip(names);
    let crumbs = crumbs
        .filter(|(c, _)| c.crumbs_lost * 1e9 >= scene.thresholds.component_mm3.max(CRUMB_MM3));
    ComponentLoss {
        lost,
        lost_more,
        merged,
        merged_more,
        crumbs: crumbs
            .map(|(counts, name)| LostCrumbs {
                region: name.clone(),
                count: counts.crumbs - counts.crumbs_kept,
                volume_mm3: counts.crumbs_lost * 1e9,
            })
            .collect(),
    }
}

impl std::fmt::Display for ComponentReport {
    /// The component in a warning.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [x, y, z] = self.at_mm;
        let (region, volume) = (&self.region, self.volume_mm3);
        match self.piece_of_mm3 {
            None => write!(f, "a component of region {region:?} of {volume:.1} mm³")?,
            Some(whole) => write!(
                f,
                "a piece of region {region:?} of {volume:.1} mm³, which only thin necks join to a component of {whole:.0} \
                 mm³,"
            )?,
        }
        write!(f, " at ({x:.1}, {y:.1}, {z:.1}) mm")
    }
}

#[cfg(test)]
mod tests {
    use super::super::BuildReport;
    use super::super::tests::{ball, both, built, cuboid, turned};
    use super::*;
    use crate::Surface;
    use nalgebra::Rotation3;
    use palpate_tissue::{Model, Vec3};
    use proptest::prelude::*;

    /// Balls of these radii in spacings, off the middles of eight cubes of six spacings by parts of a spacing.
    fn balls(spacing: f64, balls: &[(f64, [f64; 3])]) -> Vec<(Vec3, f64)> {
        let place = |(n, (radius, off)): (usize, &(f64, [f64; 3]))| {
            let cube = Vec3::from_fn(|a, _| if n >> a & 1 == 1 { 3.0 } else { -3.0 });
            ((cube + Vec3::from(*off)) * spacing, radius * spacing)
        };
        balls.iter().enumerate().map(place).collect()
    }

    fn with_balls(spacing: f64, balls: &[(Vec3, f64)]) -> (Model, BuildReport) {
        let side = Vec3::repeat(7.0 * spacing);
        let mut all = Surface::default();
        for (at, radius) in balls {
            let mut own = ball(*radius);
            own.vertices.iter_mut().for_each(|v| *v += at);
            all = both(all, &own);
        }
        let regions = [("fat", cuboid(-side, side)), ("bone", all)];
        built(spacing * 1e3, &regions)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn each_component_is_kept_or_named_with_its_place_and_size(
            spacing in 2e-3..1e-2, places in prop::collection::vec((0.05..1.2_f64, prop::array::uniform3(-0.5..0.5_f64)), 1..8),
        ) {
            let balls = balls(spacing, &places);
            let (model, report) = with_balls(spacing, &balls);
            let region = &report.regions[1];
            let volumes: Vec<f64> = balls.iter().map(|(_, r)| ball(*r).volume() * 1e9).collect();
            let crumbs = volumes.iter().filter(|v| **v < CRUMB_MM3).count();
            prop_assert_eq!([region.input_components, region.input_crumbs], [balls.len() - crumbs, crumbs]);
            let loss = &report.component_loss;
            prop_assert!(loss.merged.is_empty(), "{:?}", loss.merged);
            for ((at, radius), volume) in balls.iter().zip(volumes).filter(|b| b.1 >= CRUMB_MM3) {
                let inside = |p: &[f64; 3]| (Vec3::from(*p) * 1e-3 - at).norm() < *radius;
                let named: Vec<&ComponentReport> = loss.lost.iter().filter(|c| inside(&c.at_mm)).collect();
                if let [lost] = named.as_slice() {
                    prop_assert!((lost.volume_mm3 / volume - 1.0).abs() < 0.1, "{lost:?} {volume}");
                } else {
                    prop_assert!(named.is_empty());
                    let near = |c: &usize| model.cells[*c].region.index() == 1
                        && (model.corners_of(*c).iter().sum::<Vec3>() / 8.0 - at).norm() < *radius;
                    prop_assert!((0..model.cells.len()).any(|c| near(&c)), "{at} {radius} {:?}", loss);
                }
            }
        }
    }

    fn block(half: f64) -> Surface {
        cuboid(Vec3::repeat(-half), Vec3::repeat(half))
    }

    /// A rod oblique to the lattice, about the origin.
    fn rod(radius: f64, length: f64) -> Surface {
        let mut rod = turned(&[(radius, -length / 2.0), (radius, length / 2.0)], 16);
        let turn = Rotation3::from_euler_angles(0.7, 0.4, 0.2);
        rod.vertices.iter_mut().for_each(|v| *v = turn * *v);
        rod
    }

    /// Builds a body in fat: its only component is lost, with its volume.
    fn assert_is_lost_whole(body: Surface) {
        let volume = body.volume() * 1e9;
        let (_, report) = built(4.0, &[("fat", block(0.03)), ("body", body)]);
        assert_eq!(report.regions[1].input_components, 1);
        let [lost] = report.component_loss.lost.as_slice() else {
            panic!("{:?}", report.component_loss);
        };
        assert!(
            (lost.volume_mm3 / volume - 1.0).abs() < 0.1,
            "{lost:?} {volume}"
        );
        assert_eq!(lost.piece_of_mm3, None);
    }

    #[test]
    fn rod_too_thin_for_neighbouring_rays_is_one_component() {
        let thin = rod(0.4e-3, 0.05);
        assert_is_lost_whole(thin);
    }

    #[test]
    fn later_region_cuts_a_rod_in_two_components() {
        let wall = || {
            let half = Vec3::new(0.004, 0.03, 0.03);
            cuboid(-half, half)
        };
        for radius in [2e-3, 6e-3] {
            let regions = [
                ("fat", block(0.03)),
                ("nerve", rod(radius, 0.05)),
                ("wall", wall()),
            ];
            let (_, report) = built(4.0, &regions);
            assert_eq!(report.regions[1].input_components, 2, "{report:?}");
        }
    }

    #[test]
    fn piece_that_a_thin_neck_joins_is_named_as_a_piece() {
        let profile = [
            (15.0, -30.0),
            (15.0, 0.0),
            (0.1, 0.0),
            (0.1, 20.0),
            (2.5, 20.0),
            (2.5, 25.0),
        ];
        let bulb = turned(&profile.map(|(r, z)| (r * 1e-3, z * 1e-3)), 32);
        let (_, report) = built(6.0, &[("fat", block(0.04)), ("bone", bulb)]);
        let region = &report.regions[1];
        assert_eq!([region.components, region.input_components], [1, 1]);
        let [lost] = report.component_loss.lost.as_slice() else {
            panic!("{:?}", report.component_loss);
        };
        assert!((lost.volume_mm3 / 98.0 - 1.0).abs() < 0.3, "{lost:?}");
        assert!((20.0..25.0).contains(&lost.at_mm[2]), "{lost:?}");
        let whole = lost.piece_of_mm3.unwrap();
        assert!(
            (whole / region.input_volume_mm3 - 1.0).abs() < 0.01,
            "{lost:?}"
        );
        let named = |w: &&String| w.contains("a piece of region \"bone\" of");
        assert_eq!(report.warnings.iter().filter(named).count(), 1);
    }

    #[test]
    fn later_region_cuts_a_body_along_each_axis_in_two_components() {
        for axis in 0..3 {
            for thickness in [0.01, 0.0005] {
                let mut long = Vec3::repeat(thickness / 2.0);
                long[axis] = 0.025;
                long[(axis + 1) % 3] = 0.005;
                let mut slab = Vec3::repeat(0.03);
                slab[axis] = 0.004;
                let regions = [
                    ("fat", block(0.03)),
                    ("muscle", cuboid(-long, long)),
                    ("bone", cuboid(-slab, slab)),
                ];
                let (_, report) = built(4.0, &regions);
                let loss = &report.component_loss;
                let named = loss.lost.iter().filter(|l| l.region == "muscle").count();
                let kept = report.regions[1].components;
                assert!(kept == 2 || named >= 2, "{axis} {thickness} {loss:?}");
                if thickness > 0.004 {
                    assert_eq!(report.regions[1].input_components, 2, "{axis}");
                }
            }
        }
    }

    #[test]
    fn hollow_ball_has_the_volume_of_its_wall() {
        let mut inner = ball(0.0037);
        inner.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        let shell = both(ball(0.004), &inner);
        assert_is_lost_whole(shell);
    }

    #[test]
    fn lost_crumbs_are_named_together() {
        // A sheet between the rays, pierced: what is left of it is known to single rays only.
        let half = Vec3::new(0.025, 0.025, 0.00005);
        let turn = Rotation3::from_euler_angles(0.7, 0.4, 0.2);
        let mut sheet = cuboid(-half, half);
        sheet.vertices.iter_mut().for_each(|v| *v = turn * *v);
        let regions = [
            ("fat", block(0.04)),
            ("fascia", sheet),
            ("bone", ball(0.005)),
        ];
        let (_, report) = built(4.0, &regions);
        let [crumbs] = report.component_loss.crumbs.as_slice() else {
            panic!("{:?}", report.component_loss);
        };
        assert!((200.0..260.0).contains(&crumbs.volume_mm3), "{crumbs:?}");
        let named = |w: &&String| w.contains("components of region \"fascia\" below 1 mm³");
        assert_eq!(report.warnings.iter().filter(named).count(), 1);
    }
}
