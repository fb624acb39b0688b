//! Forms and matrices that equal bricks and equal elements share.

use std::collections::BTreeMap;
use std::sync::Arc;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::brick::{DIRECTIONS, Form, LOCALS, SPAN};
use super::element::{Matrix, Sum};
use super::lanes::LANES;

/// Forms and matrices, numbered permanently: a cut only computes new ones.
#[derive(Clone, Default)]
pub(super) struct Kinds {
    pub(super) forms: Vec<Arc<Form>>,
    form_of: BTreeMap<u128, u32>,
    pub(super) levels: Vec<LevelKinds>,
}

/// Matrices of one level by their parts.
#[derive(Clone, Default)]
pub(super) struct LevelKinds {
    pub(super) matrices: Vec<Arc<Matrix>>,
    known: BTreeMap<Parts, u32>,
}

/// Parts of an element: forms and fixed nodes of its bricks, or matrices and octants of its children.
pub(super) type Parts = Vec<(u32, u32)>;

impl Kinds {
    /// Kinds with these forms.
    pub(super) fn of_forms(forms: Vec<Arc<Form>>) -> Self {
        Self {
            form_of: forms.iter().map(|form| form.key()).zip(0..).collect(),
            forms,
            levels: Vec::new(),
        }
    }

    /// Adds the next level, whose elements have these matrices and parts.
    pub(super) fn add_level(
        &mut self,
        matrices: &[Arc<Matrix>],
        matrix: &[u32],
        parts: Vec<Parts>,
    ) {
        self.levels.push(LevelKinds {
            matrices: matrices.to_vec(),
            known: parts.into_iter().zip(matrix.iter().copied()).collect(),
        });
    }

    /// The number of a form with its key.
    pub(super) fn form(&mut self, form: Arc<Form>, key: u128) -> u32 {
        *self.form_of.entry(key).or_insert_with(|| {
            self.forms.push(form);
            self.forms.len() as u32 - 1
        })
    }

    /// Numbers of the matrices of elements of a level; elements with equal parts share one.
    pub(super) fn matrices(&mut self, l: usize, parts: &[Parts], per_spacing: f32) -> Vec<u32> {
        if self.levels.len() == l {
            self.levels.push(LevelKinds::default());
        }
        let (finer, coarser) = self.levels.split_at_mut(l);
        let finer = finer.last().map(|level| &*level);
        let LevelKinds { matrices, known } = &mut coarser[0];
        let mut new: Vec<&Parts> = Vec::new();
        let from = matrices.len();
        let index = parts
            .iter()
            .map(|list| {
                if let Some(&index) = known.get(list) {
                    return index;
                }
                let index = (from + new.len()) as u32;
                known.insert(list.clone(), index);
                new.push(list);
                index
            })
            .collect();
        let forms = &self.forms;
        let arch = Arch::new();
        let made: Vec<Arc<Matrix>> = new
            .par_iter()
            .map(|list| {
                Arc::new(arch.dispatch(MatrixOf {
                    list,
                    forms,
                    finer,
                    per_spacing,
                }))
            })
            .collect();
        matrices.extend(made);
        index
    }
}

/// The matrix of an element with these parts.
struct MatrixOf<'a> {
    list: &'a Parts,
    forms: &'a [Arc<Form>],
    finer: Option<&'a LevelKinds>,
    per_spacing: f32,
}

impl WithSimd for MatrixOf<'_> {
    type Output = Matrix;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Matrix {
        let Self { list, forms, .. } = self;
        let mut sum = Sum::new();
        for &(part, how) in list {
            match self.finer {
                None => sum.add_brick(simd, &forms[part as usize], how, self.per_spacing),
                Some(level) => sum.add_child(simd, &level.matrices[part as usize], how as usize),
            }
        }
        let alike = list.iter().all(|part| part.0 == list[0].0)
            && match self.finer {
                None => forms[list[0].0 as usize].is_regular(self.per_spacing),
                Some(level) => level.matrices[list[0].0 as usize].even,
            };
        sum.finish(simd, alike)
    }
}

/// Size of the numbers that a key covers.
const KEY_BYTES: usize = size_of::<f32>() * (3 * LOCALS + DIRECTIONS * SPAN + 3 * LANES + 3);

impl Form {
    /// Equal keys mean equal forms.
    pub(super) fn key(&self) -> u128 {
        let arrays = self.rest.iter().map(|axis| &axis[..LOCALS]);
        let arrays = arrays.chain(self.stiffness.iter().map(|row| &row[..]));
        let curve = [
            self.curve.stiffening,
            self.curve.limits[0],
            self.curve.limits[1],
        ];
        let arrays = arrays.chain([&self.bulk[..], &self.per_volume, &curve, &self.corner]);
        let mut bytes = Vec::with_capacity(KEY_BYTES);
        for v in arrays.flatten() {
            bytes.extend_from_slice(&v.to_bits().to_le_bytes());
        }
        xxhash_rust::xxh3::xxh3_128(&bytes)
    }
}
