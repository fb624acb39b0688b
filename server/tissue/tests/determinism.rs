//! The same steps give the same bits on any number of threads, with any vector width, in any build.

use std::sync::Arc;

mod strokes;

use palpate_tissue::{Budget, Material, Tissue, Tool, Topology, TopologyCut, Vec3, block};
use rand::SeedableRng;
use rand_pcg::Pcg64;
use strokes::random_stroke::{pieces, random_stroke};

/// Hash of a press into a block of 14 thousand cells with a volume term and stiffening springs. It changes only
/// with the force law or the solver, and then on every machine.
const GOLDEN: u64 = 0xf07f_ad23_5c6e_5ab8;

/// Hashes of the topology after random strokes in parts, an undo and a redo, and of the shape under a ball. They change
/// only with the rules of cuts or the solver.
const GOLDEN_CUT: [u64; 2] = [0xe3f4_8adb_c521_15b6, 0xa0e7_e0e6_2b87_f3cb];

fn press(threads: usize) -> u64 {
    let material = Material {
        poisson: 0.35,
        stiffening: 2.0,
        ..Material::default()
    };
    let topology = Topology::new(Arc::new(block([24, 24, 24], 4e-3, &material, 1)));
    let mut tissue = Tissue::at_rest(topology.clone());
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .expect("threads");
    pool.install(|| {
        for step in 1..=3 {
            let tool = Tool::ball(
                1,
                Vec3::new(0.047, 0.05, 0.096 + 0.012 - 1e-3 * f64::from(step)),
                0.012,
            );
            // A small tolerance refines every brick, so that the threads have work to share.
            tissue.step(&[tool], Budget::new(4, 1e-6));
        }
    });
    tissue.shape().hash()
}

#[test]
fn press_is_bit_equal_on_any_thread_count_and_in_any_build() {
    for threads in [1, 2, 4] {
        assert_eq!(press(threads), GOLDEN, "{:#x} on {threads}", press(threads));
    }
}

fn cut_and_press(threads: usize) -> [u64; 2] {
    const SPACING_M: f64 = 4e-3;
    let fat = Material::built_in("fat").expect("material");
    let model = Arc::new(block([20, 20, 10], SPACING_M, &fat, 1));
    let mut tissue = Tissue::new(model);
    let mut preparer = tissue.preparer();
    let mut random = Pcg64::seed_from_u64(29);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .expect("threads");
    pool.install(|| {
        for _ in 0..6 {
            let stroke = random_stroke(preparer.topology(), &mut random);
            for part in pieces(&stroke, 0.01, SPACING_M) {
                if let Ok(cut) = preparer.prepare(&part) {
                    tissue.succeed(cut);
                }
            }
        }
        let undone = [0, 1].map(|_| preparer.undo().map(TopologyCut::finish));
        undone
            .into_iter()
            .flatten()
            .for_each(|cut| drop(tissue.succeed(cut)));
        let redone = preparer
            .redo()
            .expect("a stroke to redo")
            .expect("redo")
            .finish();
        tissue.succeed(redone);
        for step in 1..=3 {
            let height = 0.04 + 0.012 - 1e-3 * f64::from(step);
            let tool = Tool::ball(1, Vec3::new(0.041, 0.037, height), 0.012);
            tissue.step(&[tool], Budget::new(4, 1e-6));
        }
    });
    [tissue.topology().hash().0, tissue.shape().hash()]
}

#[test]
fn cuts_are_bit_equal_on_any_thread_count_and_in_any_build() {
    for threads in [1, 2, 4] {
        let hashes = cut_and_press(threads);
        assert_eq!(hashes, GOLDEN_CUT, "{hashes:#x?} on {threads}");
    }
}
