//! Moduli of built bars against those of their materials: closed-form cases, at several spacings and
//! orientations on the lattice.

#![allow(clippy::unwrap_used)]

use std::path::PathBuf;
use std::sync::Arc;

use nalgebra::Rotation3;
use palpate_anatomy::surface::Unit;
use palpate_anatomy::{RegionSource, Scene, SceneInput, SceneRegion, Surface, build};
use palpate_tissue::material::MaterialOverride;
use palpate_tissue::{Budget, Tissue, Topology, Vec3};

const MM: f64 = 1e-3;
const YOUNG_PA: f64 = 10e3;
/// Residual of a solve; the results are accurate to 5 %.
const TOLERANCE: f64 = 5e-4;
/// Half width and half length of a bar in m.
const HALF: [f64; 3] = [12.0 * MM, 12.0 * MM, 40.0 * MM];

/// A rotated closed box from `low` to `high`.
fn cuboid(low: Vec3, high: Vec3, turn: &Rotation3<f64>) -> Surface {
    let corner = |c: usize| {
        let pick = |a: usize| if c >> a & 1 == 1 { high[a] } else { low[a] };
        turn * Vec3::new(pick(0), pick(1), pick(2))
    };
    let faces = palpate_tissue::cell::FACES;
    Surface {
        vertices: (0..8).map(corner).collect(),
        triangles: faces
            .iter()
            .flat_map(|f| [[f[0], f[1], f[2]], [f[0], f[2], f[3]]])
            .map(|t| t.map(|i| i as u32))
            .collect(),
    }
}

/// A model of boxes, the first around the others, with a material for each.
fn model(
    boxes: &[(Vec3, Vec3, f64)],
    poisson: f64,
    spacing: f64,
    turn: &Rotation3<f64>,
) -> Topology {
    let region = |i: usize| SceneRegion {
        name: format!("part{i}"),
        source: RegionSource::Surface {
            file: PathBuf::from("none"),
            unit: Unit::Metre,
        },
        material: format!("m{i}"),
        change: MaterialOverride::default(),
    };
    let material = |i: usize| {
        let change = MaterialOverride {
            young_pa: Some(boxes[i].2),
            poisson: Some(poisson),
            density_kg_m3: Some(1000.0),
            ..MaterialOverride::default()
        };
        (format!("m{i}"), change)
    };
    let scene = Scene {
        spacing_m: spacing,
        regions: (0..boxes.len()).map(region).collect(),
        materials: (0..boxes.len()).map(material).collect(),
        auto_spacing: false,
        thresholds: palpate_anatomy::Thresholds::default(),
        fuse: Vec::new(),
        pinned: Vec::new(),
        gravity_m_s2: [0.0; 3],
        base: PathBuf::new(),
    };
    let surfaces = boxes.iter().map(|b| cuboid(b.0, b.1, turn)).collect();
    let input = SceneInput::new(scene, surfaces).unwrap();
    let (model, _) = build(&input, &mut |_, _| {}).unwrap();
    Topology::new(Arc::new(model))
}

fn bar(poisson: f64, spacing: f64, turn: &Rotation3<f64>) -> Topology {
    let half = Vec3::from(HALF);
    model(&[(-half, half, YOUNG_PA)], poisson, spacing, turn)
}

/// Prescribes a displacement field on the nodes that `on` selects; returns their numbers.
fn prescribe(tissue: &mut Tissue, field: impl Fn(u32, Vec3) -> Option<Vec3>) -> Vec<u32> {
    let (topology, mut held) = (Arc::clone(tissue.topology()), Vec::new());
    for node in 0..topology.node_count() as u32 {
        if let Some(u) = field(node, topology.rest(node)) {
            assert!(tissue.hold(node, u));
            held.push(node);
        }
    }
    held
}

fn solve(tissue: &mut Tissue) {
    let report = tissue.step(&[], Budget::new(300, TOLERANCE));
    assert!(report.residual <= TOLERANCE, "residual {}", report.residual);
}

/// Mean displacement per distance along `of` against distance along `over`, over the middle half.
fn slope(tissue: &Tissue, of: Vec3, over: Vec3, along: Vec3) -> f64 {
    let topology = tissue.topology();
    let (mut xx, mut xy, mut x, mut y, mut n) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for node in 0..topology.node_count() as u32 {
        let p = topology.rest(node);
        if p.dot(&along).abs() < 0.4 * HALF[2] {
            let (a, b) = (
                p.dot(&over),
                tissue.shape().displacement[node as usize].dot(&of),
            );
            (xx, xy, x, y, n) = (xx + a * a, xy + a * b, x + a, y + b, n + 1.0);
        }
    }
    (n * xy - x * y) / (n * xx - x * x)
}

fn orientations() -> [Rotation3<f64>; 3] {
    [
        Rotation3::identity(),
        Rotation3::from_euler_angles(0.0, 0.4, 0.0),
        Rotation3::from_euler_angles(0.5, 0.35, 0.2),
    ]
}

/// Prescribes the ends of a bar at a strain along its axis; returns their nodes.
fn stretch(tissue: &mut Tissue, strain: f64, axis: &Vec3) -> Vec<u32> {
    prescribe(tissue, |_, p| {
        let z = p.dot(axis);
        (z.abs() > HALF[2] - 0.01 * MM).then(|| axis * (strain * z))
    })
}

/// Young's modulus and Poisson's ratio of a bar in tension.
fn tension(topology: &Topology, turn: &Rotation3<f64>) -> (f64, f64) {
    let mut tissue = Tissue::at_rest(topology.clone());
    let axes = [0, 1, 2].map(|a| turn * Vec3::ith(a, 1.0));
    let held = stretch(&mut tissue, 0.01, &axes[2]);
    solve(&mut tissue);
    let pull: f64 = held
        .iter()
        .filter(|&&n| topology.rest(n).dot(&axes[2]) > 0.0)
        .map(|&n| -tissue.force_on(n).dot(&axes[2]))
        .sum();
    let along = slope(&tissue, axes[2], axes[2], axes[2]);
    let across = 0.5
        * (slope(&tissue, axes[0], axes[0], axes[2]) + slope(&tissue, axes[1], axes[1], axes[2]));
    (pull / (4.0 * HALF[0] * HALF[1]) / along, -across / along)
}

/// Shear modulus of a bar whose whole surface is sheared.
fn shear(topology: &Topology, turn: &Rotation3<f64>) -> f64 {
    let mut tissue = Tissue::at_rest(topology.clone());
    let axes = [0, 1, 2].map(|a| turn * Vec3::ith(a, 1.0));
    let angle = 0.01;
    let held = prescribe(&mut tissue, |node, p| {
        let field = axes[0] * (angle * p.dot(&axes[2]));
        topology.on_boundary(node).then_some(field)
    });
    solve(&mut tissue);
    // Virtual work: the forces on the surface times the field are the stress times the volume.
    let work: f64 = held
        .iter()
        .map(|&n| {
            -tissue
                .force_on(n)
                .dot(&tissue.shape().displacement[n as usize])
        })
        .sum();
    work / (angle * angle) / (8.0 * HALF[0] * HALF[1] * HALF[2])
}

#[test]
fn bar_moduli_match_the_material() {
    for poisson in [0.25, 0.35, 0.45] {
        for spacing in [4.0 * MM, 3.0 * MM, 2.0 * MM] {
            for (i, turn) in orientations().iter().enumerate() {
                let topology = bar(poisson, spacing, turn);
                let (young, ratio) = tension(&topology, turn);
                let rigidity = shear(&topology, turn);
                let asked = YOUNG_PA / (2.0 * (1.0 + poisson));
                let told = format!(
                    "Poisson {poisson}, spacing {spacing}, orientation {i}: E {:.3}, ν {ratio:.3}, G {:.3}",
                    young / YOUNG_PA,
                    rigidity / asked
                );
                assert!((young / YOUNG_PA - 1.0).abs() < 0.05, "{told}");
                assert!((ratio - poisson).abs() < 0.02, "{told}");
                assert!((rigidity / asked - 1.0).abs() < 0.05, "{told}");
            }
        }
    }
}

/// Iterations of a bar in tension to a residual of 1e-6.
fn iterations(poisson: f64, turn: &Rotation3<f64>) -> usize {
    let mut tissue = Tissue::at_rest(bar(poisson, 4.0 * MM, turn));
    stretch(&mut tissue, 0.01, &(turn * Vec3::z()));
    let report = tissue.step(&[], Budget::new(200, 1e-6));
    assert!(report.residual <= 1e-6, "residual {}", report.residual);
    report.iterations
}

/// Bars turned about three axes have cells a tenth as thick as a cube.
#[test]
fn nearly_incompressible_bars_converge_in_at_most_three_times_the_iterations() {
    for turn in orientations() {
        let [springs, nearly] = [0.25, 0.45].map(|poisson| iterations(poisson, &turn));
        assert!(nearly <= 3 * springs, "{nearly} instead of {springs}");
    }
}

/// [`iterations`] fails beyond 200. Without conjugate directions the two turned bars take 270 and 365.
#[test]
fn bars_with_a_poisson_ratio_of_0_49_converge_in_200_iterations() {
    for turn in orientations() {
        iterations(0.49, &turn);
    }
}

#[test]
fn bars_in_series_and_parallel_follow_closed_forms() {
    let half = Vec3::from(HALF);
    let turn = Rotation3::identity();
    let strain = 0.01;
    // The second box fills the upper half of the bar's length, or one half of its width.
    for (axis, closed) in [(2, 2.0 / (1.0 + 0.2)), (0, 0.5 * (1.0 + 5.0))] {
        let mut low = -half;
        low[axis] = 0.0;
        let boxes = [(-half, half, YOUNG_PA), (low, half, 5.0 * YOUNG_PA)];
        let topology = model(&boxes, 0.25, 4.0 * MM, &turn);
        let mut tissue = Tissue::at_rest(topology.clone());
        let held = prescribe(&mut tissue, |_, p| {
            (p.z.abs() > HALF[2] - 0.01 * MM).then(|| Vec3::z() * (strain * p.z))
        });
        solve(&mut tissue);
        let pull: f64 = held
            .iter()
            .filter(|&&n| topology.rest(n).z > 0.0)
            .map(|&n| -tissue.force_on(n).z)
            .sum();
        let young = pull / (4.0 * HALF[0] * HALF[1]) / strain;
        let error = young / (closed * YOUNG_PA) - 1.0;
        assert!(error.abs() < 0.05, "axis {axis}: {error}");
    }
}
