use pulp::{Arch, Scalar};

use super::*;
use crate::equilibrium::brick::Draft;
use crate::equilibrium::lanes::LANES;
use crate::{Material, Model, Topology, block};

/// A distorted brick of a material that uses every term, and displacements that fold it.
fn brick(stiffening: f64, bottoms_out: bool) -> (Brick, Form, Vec<Vec3>) {
    let material = Material {
        poisson: 0.4,
        stiffening,
        bottoms_out,
        ..Material::default()
    };
    let mut model: Model = block([2, 2, 2], 4e-3, &material, 0);
    let noise = |i: usize, a: usize| ((i * 31 + a * 17) % 23) as f64 / 23.0 - 0.5;
    for (i, p) in model.nodes.iter_mut().enumerate() {
        *p += Vec3::new(noise(i, 0), noise(i, 1), noise(i, 2)) * 1e-3;
    }
    let u = (0..27)
        .map(|i| Vec3::new(noise(i, 3), noise(i, 4), noise(i, 5)) * 9e-3)
        .collect();
    let (brick, form) = brick_of(model);
    (brick, form, u)
}

/// The brick of a block of eight cells.
fn brick_of(model: Model) -> (Brick, Form) {
    let topology = Topology::new(model.into());
    let cells: Vec<(usize, u32)> = (0..8).map(|c| (c, c as u32)).collect();
    let mut drafts = Vec::new();
    Draft::of(&topology, &cells, &mut drafts);
    drafts[0].finish(Scalar::new(), &topology)
}

#[test]
fn vectors_of_any_width_give_the_same_bits() {
    for bottoms_out in [false, true] {
        let (brick, form, u) = brick(3.0, bottoms_out);
        same_bits(&brick, &form, &u);
        let (brick, form, u) = self::brick(0.0, bottoms_out);
        same_bits(&brick, &form, &small(&u));
    }
}

/// A small part of the displacements.
fn small(u: &[Vec3]) -> Vec<Vec3> {
    u.iter().map(|u| u * 0.02).collect()
}

fn same_bits(brick: &Brick, form: &Form, u: &[Vec3]) {
    let bits = |rows: &[&[f32]]| -> Vec<u32> {
        let numbers = rows.iter().flat_map(|row| &row[..LOCALS]);
        numbers.map(|v| v.to_bits()).collect()
    };
    let forces = |wide: bool| {
        let (mut f, scratch) = ([[0.0; LOCALS]; 3], &mut Ends::new());
        let op = Forces {
            brick,
            form,
            u,
            to: &mut f,
            scratch,
        };
        if wide {
            Arch::new().dispatch(op);
        } else {
            op.with_simd(Scalar);
        }
        bits(&f.each_ref().map(|row| &row[..]))
    };
    let tangents = |wide: bool| {
        let scratch = &mut Ends::new();
        let op = Tangents {
            brick,
            form,
            u: Some(u),
            per_spacing: 250.0,
            scratch,
        };
        let m = if wide {
            Arch::new().dispatch(op)
        } else {
            op.with_simd(Scalar)
        };
        bits(&m.each_ref().map(|row| &row[..]))
    };
    assert_eq!(forces(true), forces(false));
    assert_eq!(tangents(true), tangents(false));
}

/// At a small strain, and at one with held and extreme springs and hardened corners.
#[test]
fn forces_sum_to_zero_and_have_a_potential() {
    let (brick, form, u) = brick(3.0, true);
    for scale in [0.01, STRAINED] {
        let u: Vec<Vec3> = u.iter().map(|u| u * scale).collect();
        has_a_potential(&brick, &form, &u);
    }
}

#[test]
fn brick_rotated_by_sixty_degrees_has_no_force() {
    let (brick, form, _) = brick(3.0, true);
    let turn = nalgebra::Rotation3::from_scaled_axis(Vec3::new(0.3, -0.5, 0.86).normalize() * 1.05);
    let mut turned = vec![Vec3::zeros(); LOCALS];
    for (i, &node) in brick.nodes.iter().enumerate() {
        let p = Vec3::from([0, 1, 2].map(|a| f64::from(form.rest[a][i])));
        turned[node as usize] = turn * p - p;
    }
    let (f, strained) = (
        forces(&brick, &form, &turned),
        forces(&brick, &form, &strain()),
    );
    let size = |f: &[[f32; LOCALS]; 3]| -> f32 { f.iter().flatten().map(|v| v.abs()).sum() };
    assert!(
        size(&f) < 1e-4 * size(&strained),
        "{} {}",
        size(&f),
        size(&strained)
    );
}

#[test]
fn corners_push_only_in_a_strained_brick() {
    let (brick, form, u) = brick(3.0, true);
    let mut soft = form.clone();
    soft.corner = [0.0; LANES];
    for (scale, push) in [(0.02, false), (STRAINED, true)] {
        let u: Vec<Vec3> = u.iter().map(|u| u * scale).collect();
        assert_eq!(forces(&brick, &form, &u) != forces(&brick, &soft, &u), push);
    }
}

/// A corner hardens when it loses half of its own volume, however little that is, so blocks at rest do not allow for it.
#[test]
fn corners_flat_at_rest_add_nothing_to_the_blocks_at_rest() {
    let mut model = block([2, 2, 2], 4e-3, &Material::default(), 0);
    // One node just above the plane of its three neighbours in a cell.
    model.nodes[13] -= Vec3::repeat(0.66) * 4e-3;
    let (brick, form) = brick_of(model);
    assert!(form.skewed);
    let mut soft = form.clone();
    soft.corner = [0.0; LANES];
    let blocks = |form: &Form| {
        let scratch = &mut Ends::new();
        Tangents {
            brick: &brick,
            form,
            u: None,
            per_spacing: 250.0,
            scratch,
        }
        .with_simd(Scalar)
    };
    assert!(blocks(&form) == blocks(&soft));
}

/// Part of the displacements that strains the brick without folding it.
const STRAINED: f64 = 0.25;

fn strain() -> Vec<Vec3> {
    brick(3.0, true).2.iter().map(|u| u * STRAINED).collect()
}

fn forces(brick: &Brick, form: &Form, u: &[Vec3]) -> [[f32; LOCALS]; 3] {
    let mut forces = [[0.0; LOCALS]; 3];
    Arch::new().dispatch(Forces {
        brick,
        form,
        u,
        to: &mut forces,
        scratch: &mut Ends::new(),
    });
    forces
}

fn has_a_potential(brick: &Brick, form: &Form, u: &[Vec3]) {
    let bound = Arch::new().dispatch(Tangents {
        brick,
        form,
        u: Some(u),
        per_spacing: 250.0,
        scratch: &mut Ends::new(),
    });
    for row in &forces(brick, form, u) {
        let sum: f32 = row.iter().sum();
        let size: f32 = row.iter().map(|v| v.abs()).sum();
        assert!(sum.abs() < 1e-4 * size, "{sum} of {size}");
    }
    // Force change on all nodes by one node's move along an axis, by differences.
    let step = 1e-6;
    let stiffness: Vec<[[f32; LOCALS]; 3]> = (0..3 * LOCALS)
        .map(|i| {
            let by = |sign: f64| {
                let mut moved = u.to_vec();
                moved[i / 3][i % 3] += sign * f64::from(step);
                forces(brick, form, &moved)
            };
            let (on, back) = (by(1.0), by(-1.0));
            let row = |a: usize, j: usize| (back[a][j] - on[a][j]) / (2.0 * step);
            [0, 1, 2].map(|a| std::array::from_fn(|j| row(a, j)))
        })
        .collect();
    for i in 0..3 * LOCALS {
        let (own, most) = (stiffness[i][i % 3][i / 3], bound[i % 3][i / 3]);
        assert!(own > 0.0 && own < most, "{i}: {own}, {most}");
        for j in 0..i {
            let (a, b) = (stiffness[i][j % 3][j / 3], stiffness[j][i % 3][i / 3]);
            assert!((a - b).abs() < 0.02 * own, "{i} {j}: {a} {b}");
        }
    }
}
