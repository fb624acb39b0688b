//! From strokes over a surface to strokes of a blade at rest.
//!
//! A point of the file is the place where the blade enters the surface; its tip is one depth further along the
//! direction. The blade reaches one spacing out of the surface, because a straight line between two points on a curved
//! surface runs below it.

use std::collections::HashSet;

use palpate_tissue::limits::{BLADE_DEPTH_MAX_M, BLADE_POINTS_MAX};
use palpate_tissue::{BladePoint, CutStroke, FaceId, Topology, Vec3};

use super::strokes_file::{Depth, StrokeEntry};
use super::triangle_grid::TriangleGrid;
use super::walls::wall_faces;

const MM: f64 = 1e3;
/// How far the blade reaches out of the surface, in spacings.
const ABOVE: f64 = 1.0;
/// Largest distance, in spacings, of a point without direction from the surface that gives it its direction.
const SURFACE_REACH: f64 = 5.0;

/// Product with the inward normal below which a direction points out of the surface. Averaged normals near edges need some tolerance.
const OUTWARDS: f64 = -0.3;

/// The outer surface of a model without the walls of wounds, for the direction of strokes.
pub(super) struct EntrySurface {
    grid: TriangleGrid,
    /// Outward normal at each corner of each triangle, of length 1 where the surface is smooth.
    normals: Vec<[Vec3; 3]>,
    spacing_m: f64,
}

impl EntrySurface {
    pub(super) fn of(topology: &Topology) -> Self {
        let spacing_m = topology.model().spacing_m;
        let boundary = topology.boundary();
        let walls: HashSet<FaceId> = wall_faces(topology).into_iter().collect();
        let faces = boundary
            .faces
            .iter()
            .zip(boundary.triangles.chunks_exact(2));
        let triangles: Vec<[u32; 3]> = faces
            .filter(|(face, _)| !walls.contains(face))
            .flat_map(|(_, pair)| pair.iter().copied())
            .collect();
        let places: Vec<[Vec3; 3]> = triangles
            .iter()
            .map(|t| t.map(|n| topology.rest(n)))
            .collect();
        let mut at_node = vec![Vec3::zeros(); topology.node_count()];
        for (triangle, [a, b, c]) in triangles.iter().zip(&places) {
            let area = (b - a).cross(&(c - a));
            for &node in triangle {
                at_node[node as usize] += area;
            }
        }
        let normal = |&n: &u32| at_node[n as usize].try_normalize(0.0).unwrap_or_default();
        Self {
            normals: triangles
                .iter()
                .map(|t| [normal(&t[0]), normal(&t[1]), normal(&t[2])])
                .collect(),
            grid: TriangleGrid::new(places, spacing_m),
            spacing_m,
        }
    }

    /// The inward normal at the surface point nearest to `p`.
    fn inwards(&self, p: &Vec3) -> Option<Vec3> {
        let near = self.grid.nearest(p, SURFACE_REACH * self.spacing_m)?;
        let normals = &self.normals[near.triangle];
        let mean: Vec3 = normals.iter().zip(near.weights).map(|(n, w)| n * w).sum();
        mean.try_normalize(1e-6).map(|n| -n)
    }

    /// Whether a direction leads out of the surface at every point near it. The blade would reach into the tissue from its far end.
    fn points_outwards(&self, entry: &StrokeEntry, given: &Vec3) -> bool {
        let points = entry.points_mm.iter().map(|p| Vec3::from(*p) / MM);
        let places = points.filter(|at| at.iter().all(|v| v.is_finite()));
        let mut near = places.filter_map(|at| self.inwards(&at)).peekable();
        near.peek().is_some() && near.all(|inwards| inwards.dot(given) < OUTWARDS)
    }

    /// The stroke of the blade; on an impossible one, the reason.
    pub(super) fn stroke(&self, entry: &StrokeEntry) -> Result<CutStroke, String> {
        let count = entry.points_mm.len();
        if !(2..=BLADE_POINTS_MAX).contains(&count) {
            return Err(format!(
                "a stroke has 2 to {BLADE_POINTS_MAX} points, and this one has {count}; {}",
                if count < 2 {
                    "add the end of the path"
                } else {
                    "divide it, or leave out points closer than half a spacing"
                }
            ));
        }
        let given = entry.direction.map(direction).transpose()?;
        if let (Some(given), Some(own)) = (&given, entry.direction)
            && self.points_outwards(entry, given)
        {
            return Err(format!(
                "the direction {own:?} points out of the tissue at every point near the surface; turn it round, or leave it out"
            ));
        }
        let depths = depths(&entry.depth_mm, count)?;
        let above = ABOVE * self.spacing_m;
        let mut points = Vec::with_capacity(count);
        for (index, (&[x, y, z], depth_mm)) in entry.points_mm.iter().zip(depths).enumerate() {
            let at = Vec3::new(x, y, z) / MM;
            if !at.iter().all(|v| v.is_finite()) {
                return Err(format!(
                    "point {index} is [{x}, {y}, {z}], which is no place; give three finite numbers in mm"
                ));
            }
            let depth_max = (BLADE_DEPTH_MAX_M - above) * MM;
            if !(depth_mm > 0.0 && depth_mm <= depth_max) {
                return Err(format!(
                    "the depth at point {index} is {depth_mm} mm; it must be above 0 and at most {depth_max} mm"
                ));
            }
            let Some(inwards) = given.or_else(|| self.inwards(&at)) else {
                return Err(format!(
                    "point {index} at [{x}, {y}, {z}] mm is more than {} mm from the surface; move it there or give \
                     the stroke a direction",
                    SURFACE_REACH * self.spacing_m * MM
                ));
            };
            points.push(BladePoint {
                tip: at + inwards * (depth_mm / MM),
                axis: -inwards,
                depth_m: depth_mm / MM + above,
            });
        }
        Ok(CutStroke {
            points,
            width_m: entry.width_mm / MM,
        })
    }
}

fn direction(of: [f64; 3]) -> Result<Vec3, String> {
    let given = Vec3::from(of);
    let unit = given.try_normalize(0.0);
    unit.filter(|u| u.iter().all(|v| v.is_finite()))
        .ok_or_else(|| format!("the direction {of:?} has no length; give one such as [0, 0, -1]"))
}

fn depths(depth: &Depth, count: usize) -> Result<Vec<f64>, String> {
    match depth {
        Depth::Same(mm) => Ok(vec![*mm; count]),
        Depth::Each(list) if list.len() == count => Ok(list.clone()),
        Depth::Each(list) => Err(format!(
            "the stroke has {count} points and {} depths; give one depth, or one per point",
            list.len()
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_tissue::{Material, block, cut};

    fn entry(points_mm: &[[f64; 3]]) -> StrokeEntry {
        StrokeEntry {
            points_mm: points_mm.to_vec(),
            depth_mm: Depth::Same(6.0),
            width_mm: 1.0,
            direction: None,
        }
    }

    fn surface() -> EntrySurface {
        let model = block([8, 6, 5], 4e-3, &Material::default(), 1);
        EntrySurface::of(&Topology::new(model.into()))
    }

    #[test]
    fn blade_enters_along_the_inward_normal_with_its_tip_one_depth_below() {
        let surface = surface();
        // The block ends at z = 20 mm and y = 24 mm.
        let top = surface
            .stroke(&entry(&[[8.0, 12.0, 20.0], [20.0, 12.0, 21.0]]))
            .unwrap();
        for (point, x, z) in [(top.points[0], 8.0, 14.0), (top.points[1], 20.0, 15.0)] {
            assert!((point.axis - Vec3::z()).norm() < 1e-12);
            assert!((point.tip * MM - Vec3::new(x, 12.0, z)).norm() < 1e-9);
            assert!((point.top().z * MM - (z + 10.0)).abs() < 1e-9);
        }
        let side = surface
            .stroke(&entry(&[[8.0, 24.0, 8.0], [20.0, 24.0, 8.0]]))
            .unwrap();
        assert!((side.points[0].axis - Vec3::y()).norm() < 1e-12);
        let mut leaning = entry(&[[8.0, 12.0, 20.0], [20.0, 12.0, 20.0]]);
        leaning.direction = Some([0.0, 3.0, -4.0]);
        leaning.depth_mm = Depth::Each(vec![5.0, 10.0]);
        let leaning = surface.stroke(&leaning).unwrap();
        assert!((leaning.points[0].tip * MM - Vec3::new(8.0, 15.0, 16.0)).norm() < 1e-9);
        assert!((leaning.points[1].tip * MM - Vec3::new(20.0, 18.0, 12.0)).norm() < 1e-9);
    }

    #[test]
    fn direction_at_a_wound_is_that_of_the_surface_around_it() {
        let mut topology = Topology::new(block([8, 6, 5], 4e-3, &Material::default(), 1).into());
        let point = |y: f64| BladePoint {
            tip: Vec3::new(0.017, y, 0.006),
            axis: Vec3::z(),
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            points: vec![point(-0.01), point(0.04)],
            width_m: 2e-3,
        };
        cut(&mut topology, &stroke).unwrap();
        let stored = Topology::new(topology.to_model().into());
        let path = entry(&[[17.0, 4.0, 19.0], [17.0, 20.0, 18.0]]);
        for point in EntrySurface::of(&stored).stroke(&path).unwrap().points {
            assert!((point.axis - Vec3::z()).norm() < 1e-9, "{}", point.axis);
        }
    }

    #[test]
    fn impossible_stroke_is_refused_with_value_and_remedy() {
        let surface = surface();
        let path = [[8.0, 12.0, 20.0], [20.0, 12.0, 20.0]];
        let refused = |change: &dyn Fn(&mut StrokeEntry), words: &str| {
            let mut entry = entry(&path);
            change(&mut entry);
            let said = surface.stroke(&entry).unwrap_err();
            assert!(said.contains(words), "{words}: {said}");
        };
        refused(&|e| e.points_mm.truncate(1), "this one has 1; add the end");
        refused(
            &|e| e.points_mm = vec![[1.0; 3]; 100_000],
            "has 100000; divide",
        );
        refused(
            &|e| e.points_mm[1][2] = f64::NAN,
            "point 1 is [20, 12, NaN]",
        );
        refused(
            &|e| e.points_mm[0][2] = 41.0,
            "more than 20 mm from the surface",
        );
        refused(
            &|e| e.depth_mm = Depth::Same(0.0),
            "is 0 mm; it must be above 0",
        );
        refused(&|e| e.depth_mm = Depth::Same(f64::NAN), "is NaN mm");
        refused(
            &|e| e.depth_mm = Depth::Each(vec![1.0]),
            "2 points and 1 depths",
        );
        refused(&|e| e.direction = Some([0.0; 3]), "has no length");
        refused(
            &|e| e.direction = Some([0.1, 0.0, 1.0]),
            "points out of the tissue",
        );
        refused(
            &|e| e.direction = Some([f64::INFINITY, 0.0, 0.0]),
            "has no length",
        );
    }
}
