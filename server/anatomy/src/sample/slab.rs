//! Closed slabs between two height fields: layers of an excised block.

use palpate_tissue::Vec3;

use crate::surface::{Surface, Unit};

/// A block over a rectangle of the X-Z plane, from `bottom(x, z)` up to `top(x, z)` along Y.
/// Its four sides are plane, so layers of one block share them exactly. Lengths in mm.
pub(super) struct Slab<'a> {
    /// Half the width along X in mm; the block lies around x = 0.
    pub(super) half_width: f64,
    /// Length along Z in mm, from z = 0.
    pub(super) length: f64,
    /// Height of the lower face in mm.
    pub(super) bottom: &'a dyn Fn(f64, f64) -> f64,
    /// Height of the upper face in mm.
    pub(super) top: &'a dyn Fn(f64, f64) -> f64,
}

impl Slab<'_> {
    /// The closed surface with triangles of about `step_mm`, in metres.
    pub(super) fn surface(&self, step_mm: f64) -> Surface {
        let count = |length: f64| ((length / step_mm).ceil() as usize).max(1);
        let (nx, nz) = (count(2.0 * self.half_width), count(self.length));
        let middle = (self.top)(0.0, 0.0) - (self.bottom)(0.0, 0.0);
        let ny = count(middle);
        let mut surface = Surface::default();
        // index(i, k, j): column (i, k), level j from the bottom; inner levels exist on the rim.
        let mut index = vec![u32::MAX; (nx + 1) * (nz + 1) * (ny + 1)];
        let slot = |i: usize, k: usize, j: usize| (k * (nx + 1) + i) * (ny + 1) + j;
        for k in 0..=nz {
            for i in 0..=nx {
                let x = self.half_width * (2.0 * i as f64 / nx as f64 - 1.0);
                let z = self.length * k as f64 / nz as f64;
                let [low, high] = [(self.bottom)(x, z), (self.top)(x, z)];
                let is_rim = i == 0 || i == nx || k == 0 || k == nz;
                for j in (0..=ny).filter(|&j| is_rim || j == 0 || j == ny) {
                    index[slot(i, k, j)] = surface.vertices.len() as u32;
                    let y = low + (high - low) * j as f64 / ny as f64;
                    surface
                        .vertices
                        .push(Vec3::new(x, y, z) * Unit::Millimetre.metres());
                }
            }
        }
        let at = |i, k, j| index[slot(i, k, j)];
        let mut quad = |a, b, c, d| surface.triangles.extend([[a, b, c], [a, c, d]]);
        for k in 0..nz {
            for i in 0..nx {
                quad(
                    at(i, k, 0),
                    at(i + 1, k, 0),
                    at(i + 1, k + 1, 0),
                    at(i, k + 1, 0),
                );
                quad(
                    at(i, k, ny),
                    at(i, k + 1, ny),
                    at(i + 1, k + 1, ny),
                    at(i + 1, k, ny),
                );
            }
        }
        for j in 0..ny {
            for i in 0..nx {
                quad(
                    at(i, 0, j),
                    at(i, 0, j + 1),
                    at(i + 1, 0, j + 1),
                    at(i + 1, 0, j),
                );
                quad(
                    at(i, nz, j),
                    at(i + 1, nz, j),
                    at(i + 1, nz, j + 1),
                    at(i, nz, j + 1),
                );
            }
            for k in 0..nz {
                quad(
                    at(0, k, j),
                    at(0, k + 1, j),
                    at(0, k + 1, j + 1),
                    at(0, k, j + 1),
                );
                quad(
                    at(nx, k, j),
                    at(nx, k, j + 1),
                    at(nx, k + 1, j + 1),
                    at(nx, k + 1, j),
                );
            }
        }
        surface
    }
}
