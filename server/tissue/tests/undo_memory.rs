//! Taking back all cuts returns their memory.

#![allow(clippy::unwrap_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use palpate_tissue::{BladePoint, Budget, CutStroke, Material, Tissue, Tool, Vec3, block};

/// Bytes that all threads hold.
static HELD: AtomicUsize = AtomicUsize::new(0);

struct Counting;

// SAFETY: every call is handed to the system's allocator with the caller's own arguments, so its contract holds
// unchanged; the counter allocates nothing.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        HELD.fetch_add(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's layout, unchanged.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: `ptr` came from `System` with this layout, as `alloc` above gives no other.
        unsafe { System.dealloc(ptr, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const SPACING_M: f64 = 2.5e-3;
const CELLS: [usize; 3] = [32, 32, 8];

/// Short cuts in rows across the block, each 10 mm deep.
fn stroke(k: usize) -> CutStroke {
    let top = CELLS[2] as f64 * SPACING_M;
    let (row, column) = (k / 8, k % 8);
    let at = |step: usize| {
        let x = (0.7 + 1.1 * row as f64) * SPACING_M;
        let y = (0.4 + 4.0 * column as f64 + 0.5 * step as f64) * SPACING_M;
        Vec3::new(x, y, top - 0.01)
    };
    let point = |step| BladePoint {
        tip: at(step),
        axis: Vec3::z(),
        depth_m: 0.014,
    };
    CutStroke {
        points: (0..6).map(point).collect(),
        width_m: 0.0,
    }
}

#[test]
fn undo_of_all_cuts_returns_their_memory() {
    let fat = Material::built_in("fat").unwrap();
    let mut tissue = Tissue::new(Arc::new(block(CELLS, SPACING_M, &fat, 2)));
    let mut preparer = tissue.preparer();
    let ball = Tool::ball(1, Vec3::new(0.04, 0.04, 0.026), 8e-3);
    let press = |tissue: &mut Tissue| {
        for _ in 0..50 {
            tissue.step(&[ball], Budget::new(10, 1e-3));
        }
    };
    press(&mut tissue);
    let uncut = HELD.load(Ordering::Relaxed);
    let mut cuts = 0;
    for k in 0..200 {
        if let Ok(cut) = preparer.prepare(&stroke(k)) {
            drop(tissue.succeed(cut));
            // As views do.
            assert!(preparer.topology().boundary().is_closed());
            cuts += 1;
        }
    }
    press(&mut tissue);
    let cut = HELD.load(Ordering::Relaxed);
    while let Some(undone) = preparer.undo() {
        drop(tissue.succeed(undone.finish()));
    }
    press(&mut tissue);
    let undone = HELD.load(Ordering::Relaxed);
    assert!(cuts > 150, "{cuts}");
    // With the strokes that can be redone.
    assert!(
        undone as f64 <= 1.05 * uncut as f64,
        "{uncut} {cut} {undone}"
    );
}
