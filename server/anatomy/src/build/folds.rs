//! Volumes of a surface that winds around some points more than once, or the wrong way round.
//!
//! The divergence theorem counts every point as often as the surface winds around it: an overlap of two parts counts
//! twice, and an inverted part is subtracted. The model fills the points of any nonzero winding number once. So the
//! difference, the integral of w - 1 over these points, is measured along rays of three directions and subtracted.

use palpate_tissue::Vec3;

use super::rays::{Rays, cast};
use crate::{Aabb, Surface};

/// Rays across the longest side of the surface: an overlap of a quarter of it is measured within a percent.
const RAYS: f64 = 512.0;
/// Offset of the first ray, in steps. Surfaces rarely lie in these planes.
const OFFSET: f64 = 0.382;
/// Part of the volume from which a fold is reported. Surfaces of segmentations have smaller ones everywhere.
const REPORTED: f64 = 1e-3;

/// A volume in m³, and the box around it.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Fold {
    pub(super) volume: f64,
    pub(super) bounds: Option<Aabb>,
}

/// Folds of a surface.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Folds {
    /// Volume in m³ of all points with a nonzero winding number.
    pub(super) volume: f64,
    /// Points inside more than once, each counted as often as it is repeated.
    repeated: Fold,
    /// Points around which the surface winds the wrong way round.
    inverted: Fold,
}

impl Folds {
    /// Measures the folds of a surface.
    pub(super) fn measure(surface: &Surface, spacing: f64) -> Self {
        let mut folds = Self::default();
        let Some(bounds) = surface.aabb() else {
            return folds;
        };
        let step = (bounds.extent().max() / RAYS).min(spacing / 2.0);
        let (mut filled, mut excess, mut cancel) = (0.0, 0.0, true);
        for axis in 0..3 {
            let sides = [(axis + 1) % 3, (axis + 2) % 3];
            let rays = Rays {
                axis,
                first: sides.map(|a| bounds.min[a] + OFFSET * step),
                step,
                count: sides.map(|a| (bounds.extent()[a] / step).ceil() as usize),
            };
            let hits = cast(surface, &rays);
            let share = step * step / 3.0;
            for row in 0..rays.count[1] {
                for column in 0..rays.count[0] {
                    let mut at = Vec3::zeros();
                    at[sides[0]] = rays.first[0] + column as f64 * step;
                    at[sides[1]] = rays.first[1] + row as f64 * step;
                    cancel &= hits.windings(rays.index([column, row]), |from, to, winding| {
                        let volume = (to - from) * share;
                        filled += volume;
                        excess += volume * f64::from(winding - 1);
                        let ends = [from, to].map(|depth| {
                            at[axis] = depth;
                            at
                        });
                        if winding.abs() > 1 {
                            folds
                                .repeated
                                .add(volume * f64::from(winding.abs() - 1), ends);
                        }
                        if winding < 0 {
                            folds.inverted.add(volume, ends);
                        }
                    });
                }
            }
        }
        // The divergence theorem does not hold where triangles are wound inconsistently.
        folds.volume = if cancel {
            surface.volume() - excess
        } else {
            filled
        };
        folds
    }

    /// The repeated and the inverted part, where they are large enough to be reported.
    pub(super) fn reported(&self) -> [Option<Fold>; 2] {
        let large = |fold: &Fold| fold.volume > REPORTED * self.volume;
        [self.repeated, self.inverted].map(|fold| Some(fold).filter(large))
    }
}

impl Fold {
    fn add(&mut self, volume: f64, ends: [Vec3; 2]) {
        self.volume += volume;
        let [from, to] = ends;
        let grown = self.bounds.map_or(Aabb { min: from, max: to }, |b| Aabb {
            min: b.min.inf(&from),
            max: b.max.sup(&to),
        });
        self.bounds = Some(grown);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{ball, both, built, cuboid};
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn volume_is_that_of_the_union(
            offset in prop::array::uniform3(0.0_f64..0.05), side in prop::array::uniform3(0.01_f64..0.05),
            inverted: bool,
        ) {
            let first = Vec3::new(0.04, 0.03, 0.035);
            let (low, size) = (Vec3::from(offset), Vec3::from(side));
            let mut second = cuboid(low, low + size);
            if inverted {
                second.triangles.iter_mut().for_each(|t| t.swap(0, 1));
            }
            let folds = Folds::measure(&both(cuboid(Vec3::zeros(), first), &second), 2e-3);
            let common = (first.inf(&(low + size)) - low).sup(&Vec3::zeros()).product();
            // The winding number of an overlap with an inverted part is zero.
            let common = if inverted { 2.0 * common } else { common };
            let exact = first.product() + size.product() - common;
            prop_assert!((folds.volume / exact - 1.0).abs() < 0.01, "{folds:?} {exact}");
        }
    }

    #[test]
    fn overlapping_parts_are_built_as_their_union() {
        let mm = |x: f64, y: f64, z: f64| Vec3::new(x, y, z) * 1e-3;
        let parts = both(
            cuboid(mm(0.0, 0.0, 0.0), mm(40.0, 30.0, 30.0)),
            &cuboid(mm(25.0, 5.0, 5.0), mm(65.0, 25.0, 40.0)),
        );
        let (model, report) = built(3.0, &[("bone", parts)]);
        let exact = 36e3 + 28e3 - 7.5e3;
        let region = &report.regions[0];
        assert!(
            (region.input_volume_mm3 / exact - 1.0).abs() < 5e-3,
            "{region:?}"
        );
        assert!((region.volume_mm3 / exact - 1.0).abs() < 5e-3, "{region:?}");
        let reach = model.nodes.iter().map(|p| p.x).fold(0.0, f64::max);
        assert!((reach - 0.065).abs() < 1e-4, "{reach}");
        let named = |w: &&String| w.contains("overlaps itself") && w.contains("(25.0, 5.0, 5.0)");
        assert_eq!(
            report.warnings.iter().filter(named).count(),
            1,
            "{:?}",
            report.warnings
        );
    }

    #[test]
    fn inverted_part_is_filled_and_named() {
        // A ball that is mirrored below a height: its lower part is inside out.
        let (radius, height, half): (f64, f64, f64) = (0.03, -0.0101, 0.004);
        let mut twisted = ball(radius);
        let whole = twisted.volume();
        for p in &mut twisted.vertices {
            p.x *= ((p.z - height) / half).clamp(-1.0, 1.0);
        }
        let (model, report) = built(2.0, &[("twisted", twisted)]);
        let lost = (radius * radius - height * height) * half - half.powi(3) / 6.0;
        let exact = (whole - std::f64::consts::PI * lost) * 1e9;
        let region = &report.regions[0];
        assert!(
            (region.input_volume_mm3 / exact - 1.0).abs() < 5e-3,
            "{region:?}"
        );
        assert!((region.volume_mm3 / exact - 1.0).abs() < 0.01, "{region:?}");
        // Nodes of the inverted lobe are on the input surface too.
        assert!(region.distance_max_outside_thin_mm < 1.0, "{region:?}");
        assert!(model.nodes.iter().any(|p| p.z < -0.0298));
        let [folded, thin] = ["inside out in part", "thinner"]
            .map(|what| report.warnings.iter().filter(|w| w.contains(what)).count());
        assert_eq!([folded, thin], [1, 0], "{:?}", report.warnings);
        assert!(report.deviations >= 1, "{report:?}");
    }
}
