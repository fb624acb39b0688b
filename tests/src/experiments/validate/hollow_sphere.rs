//! A thick-walled sphere: its inner surface is pushed outwards, and carries the pressure of Lamé's solution.

use std::collections::HashMap;
use std::f64::consts::PI;

use palpate_anatomy::Surface;
use palpate_tissue::Vec3;

use super::comparison::{Case, Curve, CurveSet};
use super::specimen::{Specimen, YOUNG_PA, built};

const INNER_M: f64 = 10e-3;
const OUTER_M: f64 = 20e-3;
/// Displacement of the inner surface in radii.
const STRAIN: f64 = 2e-3;
/// Halvings of the edges of an icosahedron: the volume is 0.05 % below that of the sphere.
const HALVINGS: usize = 5;

/// Lamé's solution u(r) = A r + B / r².
struct Wall {
    a: f64,
    b: f64,
    pressure_pa: f64,
}

impl Wall {
    fn new(poisson: f64) -> Self {
        // Without stress on the outer surface A is this share of B.
        let share = 2.0 * (1.0 - 2.0 * poisson) / ((1.0 + poisson) * OUTER_M.powi(3));
        let b = STRAIN * INNER_M / (share * INNER_M + INNER_M.powi(-2));
        Self {
            a: share * b,
            b,
            pressure_pa: 2.0 * YOUNG_PA * b / (1.0 + poisson)
                * (INNER_M.powi(-3) - OUTER_M.powi(-3)),
        }
    }

    fn displacement(&self, r: f64) -> f64 {
        self.a * r + self.b / (r * r)
    }
}

/// A sphere around the origin.
fn sphere(radius_m: f64) -> Surface {
    let golden = 0.5 * (1.0 + 5.0_f64.sqrt());
    let mut vertices: Vec<Vec3> = Vec::new();
    for (p, q) in [
        (1.0, golden),
        (-1.0, golden),
        (1.0, -golden),
        (-1.0, -golden),
    ] {
        vertices.extend([
            Vec3::new(0.0, p, q),
            Vec3::new(p, q, 0.0),
            Vec3::new(q, 0.0, p),
        ]);
    }
    // The edges of this icosahedron are 2 long.
    let near = |i: usize, j: usize| (vertices[i] - vertices[j]).norm() < 2.1;
    let mut triangles: Vec<[u32; 3]> = Vec::new();
    for i in 0..12 {
        for j in 0..i {
            for k in 0..j {
                if near(i, j) && near(j, k) && near(k, i) {
                    let [a, b, c] = [i, j, k].map(|v| vertices[v]);
                    let outwards = a.dot(&b.cross(&c)) > 0.0;
                    let turned = if outwards { [i, j, k] } else { [i, k, j] };
                    triangles.push(turned.map(|v| v as u32));
                }
            }
        }
    }
    for _ in 0..HALVINGS {
        let mut middles = HashMap::new();
        let mut middle = |a: u32, b: u32| {
            *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                vertices.push((vertices[a as usize] + vertices[b as usize]) / 2.0);
                vertices.len() as u32 - 1
            })
        };
        let four = |[a, b, c]: [u32; 3]| {
            let [ab, bc, ca] = [middle(a, b), middle(b, c), middle(c, a)];
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        };
        triangles = triangles.into_iter().flat_map(four).collect();
        for vertex in &mut vertices {
            vertex.normalize_mut();
        }
    }
    Surface {
        vertices: vertices.into_iter().map(|v| v * radius_m).collect(),
        triangles,
    }
}

/// The wall between two spheres; triangles around the cavity face inwards.
fn surface() -> Surface {
    let (mut wall, cavity) = (sphere(OUTER_M), sphere(INNER_M));
    let first = wall.vertices.len() as u32;
    wall.vertices.extend(cavity.vertices);
    let inwards = |[a, b, c]: [u32; 3]| [a, c, b].map(|v| v + first);
    wall.triangles
        .extend(cavity.triangles.into_iter().map(inwards));
    wall
}

pub(super) fn pressure(
    is_fine: bool,
    poisson: f64,
    curve: &mut Curve,
) -> Result<[Case; 2], String> {
    let wall = Wall::new(poisson);
    let case = |quantity, expected| Case {
        name: "thick-walled sphere",
        poisson,
        quantity,
        reference: "Lamé 1852",
        expected,
        length: ("wall", OUTER_M - INNER_M),
        runs: Vec::new(),
    };
    let mut cases = [
        case("pressure inside (Pa)", wall.pressure_pa),
        case("displacement outside (m)", wall.displacement(OUTER_M)),
    ];
    let spacings: &[f64] = if is_fine {
        &[2e-3, 1.5e-3, 1e-3, 0.75e-3]
    } else {
        &[2e-3, 1.5e-3, 1e-3]
    };
    for &spacing_m in spacings {
        let model = built(vec![(surface(), YOUNG_PA)], poisson, spacing_m)?;
        let mut specimen = Specimen::new(model);
        let topology = specimen.tissue.topology().clone();
        let is_inner = |node: u32, at: Vec3| {
            topology.on_boundary(node) && at.norm() < 0.5 * (INNER_M + OUTER_M)
        };
        specimen
            .hold(|node, at| is_inner(node, at).then(|| at.normalize() * (STRAIN * INNER_M)))?;
        specimen.solve(&[]);
        let force = specimen.reaction(|node, at| is_inner(node, at).then(|| at.normalize()));
        cases[0].add(&specimen, force / (4.0 * PI * INNER_M * INNER_M));
        let radial =
            |(node, at): (u32, Vec3)| (at.norm(), specimen.displacement(node).dot(&at.normalize()));
        let outer = specimen
            .nodes()
            .filter(|&(node, at)| topology.on_boundary(node) && !is_inner(node, at));
        let outer: Vec<f64> = outer.map(|node| radial(node).1).collect();
        cases[1].add(&specimen, outer.iter().sum::<f64>() / outer.len() as f64);
        if Some(&spacing_m) == spacings.last() {
            let mut points: Vec<(f64, f64)> = specimen.nodes().map(radial).collect();
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            let closed = (0..=50).map(|i| INNER_M + f64::from(i) / 50.0 * (OUTER_M - INNER_M));
            let in_units = |p: (f64, f64)| (1e3 * p.0, 1e6 * p.1);
            curve.sets.push(CurveSet {
                poisson,
                measured: points.into_iter().map(in_units).collect(),
                reference: closed
                    .map(|r| in_units((r, wall.displacement(r))))
                    .collect(),
            });
        }
    }
    Ok(cases)
}

pub(super) fn curve() -> Curve {
    Curve {
        name: "validate-sphere",
        title: "Radial displacement in the wall of a sphere under pressure",
        axes: ["distance from the middle (mm)", "displacement (µm)"],
        sets: Vec::new(),
    }
}
