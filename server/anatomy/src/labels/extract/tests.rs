//! Guarantees of the extraction, on simple bodies and on noise.

use std::collections::BTreeMap;

use nalgebra::Matrix3;
use palpate_tissue::Vec3;
use proptest::prelude::*;

use super::*;
use crate::labels::Affine;
use crate::{Aabb, Surface};

fn volume(size: [usize; 3], label: impl Fn([usize; 3]) -> u16) -> LabelVolume {
    let [nx, ny, nz] = size;
    let labels = (0..nx * ny * nz).map(|n| label([n % nx, n / nx % ny, n / (nx * ny)]));
    LabelVolume {
        size,
        labels: labels.collect(),
        to_world: Affine {
            linear: Matrix3::identity() * 2e-3,
            origin: Vec3::new(-0.1, 0.2, 0.3),
        },
        warnings: Vec::new(),
    }
}

fn regions(labels: &[&[u16]]) -> Vec<LabelRegion> {
    labels
        .iter()
        .map(|l| LabelRegion { labels: l.to_vec() })
        .collect()
}

fn extracted(volume: &LabelVolume, labels: &[&[u16]], wrap: bool) -> Vec<RegionSurface> {
    surfaces(volume, Path::new("test.nii"), &regions(labels), wrap, 0.0).unwrap()
}

/// A ball of label 2 in a ball of label 1, with a rod of label 3 through both and out of them.
fn nested(size: usize) -> LabelVolume {
    let middle = size as f64 / 2.0 - 0.5;
    volume([size; 3], |at| {
        let p = Vec3::from_fn(|a, _| at[a] as f64 - middle);
        if p.xy().norm() < size as f64 * 0.1 {
            3
        } else if p.norm() < size as f64 * 0.25 {
            2
        } else {
            u16::from(p.norm() < size as f64 * 0.42)
        }
    })
}

/// Every edge twice, once in each direction: closed, manifold along edges, wound consistently.
fn assert_closed(surface: &Surface) {
    let mut uses: BTreeMap<[u32; 2], i32> = BTreeMap::new();
    let mut directed: BTreeMap<[u32; 2], u32> = BTreeMap::new();
    for &[a, b, c] in &surface.triangles {
        assert!(a != b && b != c && c != a);
        for [from, to] in [[a, b], [b, c], [c, a]] {
            *directed.entry([from, to]).or_default() += 1;
            *uses.entry([from.min(to), from.max(to)]).or_default() += 1;
        }
    }
    assert!(
        uses.values().all(|n| *n == 2),
        "an edge of more or fewer than two triangles"
    );
    assert!(
        directed.values().all(|n| *n == 1),
        "an edge run twice in one direction"
    );
}

/// Around every vertex the triangles form one closed fan.
fn assert_manifold_vertices(surface: &Surface) {
    let mut around: BTreeMap<u32, Vec<[u32; 2]>> = BTreeMap::new();
    for &[a, b, c] in &surface.triangles {
        around.entry(a).or_default().push([b, c]);
        around.entry(b).or_default().push([c, a]);
        around.entry(c).or_default().push([a, b]);
    }
    for (vertex, sides) in around {
        let next: BTreeMap<u32, u32> = sides.iter().map(|s| (s[0], s[1])).collect();
        assert_eq!(next.len(), sides.len());
        let (mut at, mut steps) = (sides[0][0], 0);
        while steps == 0 || at != sides[0][0] {
            at = next[&at];
            steps += 1;
        }
        assert_eq!(steps, sides.len(), "vertex {vertex} has several fans");
    }
}

fn assert_volume(found: &RegionSurface) {
    let part = found.surface.volume() / found.voxels_m3;
    assert!((part - 1.0).abs() < 0.003, "{part} of the voxels' volume");
}

/// A region and the region beyond its surface.
type Beyond = (u8, Option<u8>);

#[test]
fn neighbours_share_triangles_and_keep_their_volume() {
    let volume = nested(32);
    let found = extracted(&volume, &[&[1], &[2], &[3]], false);
    // For each triangle, the regions that have it, and the region beyond it for each of them.
    let mut faces: BTreeMap<[[u64; 3]; 3], Vec<Beyond>> = BTreeMap::new();
    for (region, found) in found.iter().enumerate() {
        assert_eq!(found.sides.len(), found.surface.triangles.len());
        assert!(found.sides.iter().all(|s| usize::from(s.behind) == region));
        assert_closed(&found.surface);
        assert_manifold_vertices(&found.surface);
        assert_volume(found);
        for t in 0..found.surface.triangles.len() {
            let corners = found.surface.corners(t);
            let mut key = corners.map(|p| [p.x.to_bits(), p.y.to_bits(), p.z.to_bits()]);
            key.sort_unstable();
            let sides = (region as u8, found.sides[t].before);
            faces.entry(key).or_default().push(sides);
        }
        let mut checked = found.surface.clone();
        let report = checked.check().unwrap();
        assert_eq!(report.winding_repaired + report.components_turned, 0);
        assert_eq!(report.degenerate_dropped + report.non_manifold_edges, 0);
    }
    let mut shared = 0;
    for sides in faces.values() {
        match sides[..] {
            [(_, across)] => assert_eq!(across, None),
            [(a, beyond_a), (b, beyond_b)] => {
                assert_eq!((beyond_a, beyond_b), (Some(b), Some(a)));
                shared += 1;
            }
            _ => panic!("a triangle of {} regions", sides.len()),
        }
    }
    assert!(
        shared > faces.len() / 3,
        "neighbours share triangles bit for bit"
    );
    // Without gaps and overlaps, the volumes add up to the whole.
    let parts: f64 = found.iter().map(|f| f.surface.volume()).sum();
    let whole = extracted(&volume, &[&[1, 2, 3]], false);
    assert!((parts / whole[0].surface.volume() - 1.0).abs() < 1e-3);
}

#[test]
fn outermost_surface_encloses_all_regions() {
    let volume = nested(24);
    let found = extracted(&volume, &[&[1], &[2], &[3]], true);
    let parts: f64 = found.iter().map(|f| f.voxels_m3).sum();
    assert!((found[0].surface.volume() / parts - 1.0).abs() < 0.003);
    assert!(found[0].voxels_m3 < parts / 1.3);
    assert!(found[0].sides.iter().all(|s| s.before.is_none()));
    let behind = |region| found[0].sides.iter().any(|s| s.behind == region);
    assert!(behind(0) && behind(2));
    assert_closed(&found[0].surface);
}

#[test]
fn shared_label_belongs_to_the_last_region() {
    let volume = nested(24);
    let found = extracted(&volume, &[&[1, 2, 3], &[3]], false);
    let counts = volume.counts();
    let voxels = |l: usize| counts[l].1 as f64 * volume.voxel_m3();
    assert!((found[0].voxels_m3 / (voxels(1) + voxels(2)) - 1.0).abs() < 1e-12);
    assert!((found[1].voxels_m3 / voxels(3) - 1.0).abs() < 1e-12);
}

#[test]
fn voxel_steps_are_smoothed() {
    // A ball of 20 voxels: the staircase has half as much area again as the ball.
    let volume = volume([48; 3], |at| {
        u16::from(Vec3::from_fn(|a, _| at[a] as f64 - 23.3).norm() < 20.0)
    });
    let surface = &extracted(&volume, &[&[1]], false)[0].surface;
    let middle = volume.to_world.world(&Vec3::repeat(23.3));
    let off: Vec<f64> = surface
        .vertices
        .iter()
        .map(|v| ((v - middle).norm() - 0.04) / 2e-3)
        .collect();
    let rms = (off.iter().map(|d| d * d).sum::<f64>() / off.len() as f64).sqrt();
    assert!(rms < 0.12, "{rms} voxels off the ball");
    let area = surface.area() / (4.0 * std::f64::consts::PI * 0.04 * 0.04);
    assert!((area - 1.0).abs() < 0.02, "{area} of a ball's area");
}

#[test]
fn surface_is_flat_with_a_sharp_rim_at_the_image_border() {
    let volume = volume([20, 20, 10], |[x, y, _]| {
        let r = (x as f64 - 9.5).hypot(y as f64 - 9.5);
        if r < 4.0 { 2 } else { u16::from(r < 8.0) }
    });
    let bounds = volume.world_bounds();
    for found in extracted(&volume, &[&[1], &[2]], true) {
        let b = found.surface.aabb().unwrap();
        assert!((b.min.z - bounds.min.z).abs() < 1e-9 && (b.max.z - bounds.max.z).abs() < 1e-9);
        let on_top = |v: &&Vec3| v.z > bounds.max.z - 1e-9;
        let reach = |points: &mut dyn Iterator<Item = &Vec3>| {
            let centre = bounds.centre();
            points.map(|v| (v - centre).xy().norm()).fold(0.0, f64::max)
        };
        let all = reach(&mut found.surface.vertices.iter());
        let top = reach(&mut found.surface.vertices.iter().filter(on_top));
        assert!(
            top > all - 4e-4,
            "the rim stands out as far as the side: {top} {all}"
        );
    }
}

#[test]
fn sheared_mirrored_and_anisotropic_voxels_keep_position_and_winding() {
    for columns in [
        [[1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 5e-3]],
        [[-1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 2e-3]],
        [[0.0, 2e-3, 0.0], [2e-3, 0.0, 0.0], [0.0, 0.5e-3, -2e-3]],
    ] {
        let mut volume = nested(24);
        volume.to_world.linear = Matrix3::from_columns(&columns.map(Vec3::from));
        let bounds = volume.world_bounds();
        for found in extracted(&volume, &[&[1], &[2], &[3]], false) {
            assert_closed(&found.surface);
            assert_volume(&found);
            assert!(found.surface.vertices.iter().all(|v| bounds.contains(v)));
        }
    }
}

#[test]
fn joining_fine_voxels_keeps_volumes() {
    // 2 mm voxels; 6.1 mm allows blocks of three, and 126 of them leave no remainder, 128 do. The rod is as thick as eight
    // blocks.
    for size in [126, 128] {
        let mut volume = nested(size);
        volume.to_world.linear[(2, 2)] = -2e-3;
        let bounds = volume.world_bounds();
        let path = Path::new("test.nii");
        let named = regions(&[&[1], &[2], &[3]]);
        let fine = surfaces(&volume, path, &named, true, 0.0).unwrap();
        let coarse = surfaces(&volume, path, &named, true, 6.1e-3).unwrap();
        for (fine, coarse) in fine.iter().zip(&coarse) {
            let triangles = [&fine, &coarse].map(|s| s.surface.triangles.len());
            assert!(triangles[1] * 3 < triangles[0], "{triangles:?}");
            assert_closed(&coarse.surface);
            assert_eq!(fine.voxels_m3, coarse.voxels_m3);
            let part = coarse.surface.volume() / fine.surface.volume();
            assert!((part - 1.0).abs() < 0.005, "{part}");
            let (a, b) = (fine.surface.aabb().unwrap(), coarse.surface.aabb().unwrap());
            assert!((a.centre() - b.centre()).norm() < 3e-3);
            let off = (a.extent() - b.extent()).amax();
            assert!(off < 6e-3, "{off}: at most a large voxel");
            // The body and the rod end with the image.
            let reaches = |b: Aabb| (b.max.z - bounds.max.z).abs() < 1e-9;
            assert_eq!(reaches(a), reaches(b));
        }
    }
}

#[test]
fn joining_voxels_keeps_one_voxel_layers() {
    let volume = volume([24; 3], |[x, y, z]| {
        let edge = |i: usize| i == 2 || i == 21;
        let inside = |i: usize| (2..22).contains(&i);
        if inside(x) && inside(y) && inside(z) {
            1 + u16::from(!(edge(x) || edge(y) || edge(z)))
        } else {
            0
        }
    });
    let named = regions(&[&[1], &[2]]);
    let path = Path::new("test.nii");
    let found = surfaces(&volume, path, &named, false, 9e-3).unwrap();
    found.iter().for_each(assert_volume);
}

#[test]
fn layer_of_two_voxels_is_not_joined() {
    // Its blocks would keep its volume, but not its place.
    let volume = volume([24; 3], |[x, y, _]| match x + y {
        0..20 => 2,
        20..23 => 1,
        _ => 0,
    });
    let named = regions(&[&[1], &[2]]);
    let path = Path::new("test.nii");
    let [apart, joined] = [0.0, 4.1e-3].map(|m| surfaces(&volume, path, &named, false, m).unwrap());
    assert_eq!(apart, joined);
}

#[test]
fn oblique_one_voxel_layer_is_one_sheet_of_even_thickness() {
    // Its voxels are connected through edges only.
    let volume = volume([24; 3], |[x, y, _]| match x + y {
        0..20 => 2,
        20 => 1,
        _ => 0,
    });
    let found = extracted(&volume, &[&[1], &[2]], false);
    let layer = &found[0].surface;
    assert_closed(layer);
    assert_manifold_vertices(layer);
    assert_volume(&found[0]);
    assert_eq!(
        crate::build::report_triangles(&layer.triangles).components,
        1
    );
    for vertex in &layer.vertices {
        let at = (vertex - volume.to_world.origin) / 2e-3;
        // At the image border the two sides still meet in the edges.
        let inner = (6.0..14.0).contains(&at.x) && (8.0..15.0).contains(&at.z);
        let off = (at.x + at.y - 20.0).abs();
        assert!(!inner || (0.35..0.65).contains(&off), "{off}");
    }
}

#[test]
fn missing_labels_are_rejected() {
    let volume = nested(12);
    let path = Path::new("test.nii");
    let missing = surfaces(&volume, path, &regions(&[&[1], &[7]]), true, 0.0).unwrap_err();
    let missing = missing.to_string();
    assert!(missing.contains("label 7 does not occur") && missing.contains("1, 2, 3"));
    let nothing = surfaces(&volume, path, &regions(&[&[1], &[1, 2]]), true, 0.0).unwrap_err();
    assert!(nothing.to_string().contains("none is left"), "{nothing}");
}

#[test]
fn extraction_is_bit_equal_on_any_thread_count() {
    let of = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap()
            .install(|| extracted(&nested(40), &[&[1], &[2], &[3]], true))
    };
    assert!(of(1) == of(3));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn random_labels_give_closed_surfaces_of_the_voxel_volume(
        size in [1_usize..9, 1_usize..9, 1_usize..9],
        noise in prop::collection::vec(0_u16..5, 512),
        coarse in 1_usize..4,
    ) {
        let [nx, ny, _] = size;
        let volume = volume(size, |[x, y, z]| {
            noise[(x / coarse + nx * (y / coarse + ny * (z / coarse))) % 512]
        });
        let labels: Vec<u16> = volume.counts().iter().map(|c| c.0).filter(|l| *l > 0).collect();
        let named: Vec<&[u16]> = labels.iter().map(std::slice::from_ref).collect();
        prop_assume!(!named.is_empty());
        for found in extracted(&volume, &named, false) {
            assert_closed(&found.surface);
            assert_manifold_vertices(&found.surface);
            assert_volume(&found);
        }
        assert_closed(&extracted(&volume, &named, true)[0].surface);
    }
}
