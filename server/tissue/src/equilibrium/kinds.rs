//! Forms and matrices that equal bricks and equal elements share.

use std::collections::BTreeSet;
use std::sync::Arc;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use xxhash_rust::xxh3::xxh3_128;

use super::brick::{Brick, DIRECTIONS, Form, LOCALS, SPAN};
use super::effective_stiffness::{SOFTER, Stiffness};
use super::element::{Dense, Sum};
use super::lanes::LANES;
use super::matrix::Matrix;
use super::nodal_stiffness::NodalStiffness;
use super::quad::{reserve, trim};
use crate::number_map::NumberMap;

/// A hash of a form or of the parts of an element; equal keys mean equal things. It has no memory of its own, because keys
/// that return with an undo would be new small objects all over the heap.
type Key = u128;

/// Numbers of things that bricks or elements share, by their keys. A number that nothing uses any more is given to the
/// next new thing: cuts replace forms all the time.
#[derive(Clone, Debug, Default, PartialEq)]
struct Numbers {
    known: NumberMap<Key, u32>,
    keys: Vec<Option<Key>>,
    uses: Vec<u32>,
    unused: BTreeSet<u32>,
}

impl Numbers {
    /// Numbers below `count` that are in use, each as often as listed.
    fn used(count: usize, list: impl Iterator<Item = (u32, Key)>) -> Self {
        let mut numbers = Self {
            keys: vec![None; count],
            uses: vec![0; count],
            ..Self::default()
        };
        reserve(&mut numbers.keys);
        reserve(&mut numbers.uses);
        numbers.known.reserve(numbers.keys.capacity());
        for (number, key) in list {
            let n = number as usize;
            numbers.uses[n] += 1;
            if numbers.keys[n].is_none() {
                numbers.keys[n] = Some(key);
                numbers.known.insert(key, number);
            }
        }
        let uses = (0..).zip(&numbers.uses);
        numbers.unused = uses.filter(|n| *n.1 == 0).map(|n| n.0).collect();
        numbers
    }

    /// The number of one more use of a key, and whether the key is new.
    fn take(&mut self, key: Key) -> (u32, bool) {
        if let Some(&number) = self.known.get(&key) {
            self.uses[number as usize] += 1;
            return (number, false);
        }
        let number = self.unused.pop_first().unwrap_or_else(|| {
            self.keys.push(None);
            self.uses.push(0);
            self.keys.len() as u32 - 1
        });
        self.keys[number as usize] = Some(key);
        self.uses[number as usize] = 1;
        self.known.insert(key, number);
        (number, true)
    }

    /// Ends a use of a number.
    fn release(&mut self, number: u32) {
        let uses = &mut self.uses[number as usize];
        *uses -= 1;
        if *uses == 0 {
            if let Some(key) = self.keys[number as usize].take() {
                self.known.remove(&key);
            }
            self.unused.insert(number);
        }
    }

    /// Adds a use of a number by a key that had it before.
    fn take_back(&mut self, number: u32, key: Key) {
        self.unused.remove(&number);
        let n = number as usize;
        self.uses[n] += 1;
        if self.keys[n].is_none() {
            self.keys[n] = Some(key);
            self.known.insert(key, number);
        }
    }

    /// Removes the numbers from `count` on, which nothing uses.
    fn truncate(&mut self, count: usize) {
        self.unused.split_off(&(count as u32));
        trim(&mut self.keys, count);
        trim(&mut self.uses, count);
    }
}

/// Things with their numbers.
pub(super) type Numbered<T> = Vec<(u32, T)>;

/// Sets the thing with a number, which may be the next one.
pub(super) fn set_numbered<T: Clone>(all: &mut Vec<T>, number: u32, item: &T) {
    match all.get_mut(number as usize) {
        Some(known) => known.clone_from(item),
        None => all.push(item.clone()),
    }
}

/// Forms and matrices by their keys: a cut only computes new ones.
#[derive(Clone, Default)]
pub(super) struct Kinds {
    pub(super) forms: Vec<Arc<Form>>,
    form_numbers: Numbers,
    /// Forms since the last change, in the order of their numbers' use.
    new_forms: Numbered<Arc<Form>>,
    pub(super) levels: Vec<LevelKinds>,
}

/// Stiffness of the elements of one level by their parts.
#[derive(Clone, Default)]
pub(super) struct LevelKinds {
    pub(super) matrices: Vec<Stiffness>,
    numbers: Numbers,
}

impl LevelKinds {
    /// Ends the use of a matrix by an element.
    pub(super) fn release(&mut self, matrix: u32) {
        self.numbers.release(matrix);
    }

    /// Adds an element with these parts that had this matrix before.
    pub(super) fn take_back(&mut self, number: u32, parts: &Parts) {
        self.numbers.take_back(number, key_of(parts));
    }

    /// Returns to the first `count` matrices, some of which were others since.
    pub(super) fn restore(&mut self, count: usize, changed: &Numbered<Stiffness>) {
        trim(&mut self.matrices, count);
        self.numbers.truncate(count);
        for (number, matrix) in changed {
            set_numbered(&mut self.matrices, *number, matrix);
        }
    }
}

/// Parts of an element: forms of its bricks with their fixed nodes and [`CUT`], or matrices and octants of its children.
pub(super) type Parts = Vec<(u32, u32)>;

/// Marks a brick with a node that a cut added or moved.
pub(super) const CUT: u32 = 1 << 31;
/// The marks of fixed nodes.
const NODES: u32 = (1 << LOCALS) - 1;

impl Kinds {
    /// Kinds of bricks with these forms.
    pub(super) fn of_bricks(forms: &[Arc<Form>], bricks: &[Brick]) -> Self {
        let keys: Vec<Key> = forms.iter().map(|form| form.key()).collect();
        let uses = bricks.iter().map(|b| (b.form, keys[b.form as usize]));
        let mut forms = forms.to_vec();
        reserve(&mut forms);
        Self {
            forms,
            form_numbers: Numbers::used(keys.len(), uses),
            ..Self::default()
        }
    }

    /// Adds the next level, whose elements have these matrices and parts.
    pub(super) fn add_level(&mut self, matrices: &[Stiffness], matrix: &[u32], parts: &[Parts]) {
        let uses = matrix.iter().copied().zip(parts.iter().map(key_of));
        let numbers = Numbers::used(matrices.len(), uses);
        let mut matrices = matrices.to_vec();
        reserve(&mut matrices);
        self.levels.push(LevelKinds { matrices, numbers });
    }

    /// Asserts equal numbers of forms and matrices.
    #[cfg(test)]
    pub(super) fn assert_same(&self, other: &Self) {
        assert_eq!(self.form_numbers, other.form_numbers);
        for (own, other) in self.levels.iter().zip(&other.levels) {
            assert_eq!(own.numbers, other.numbers);
        }
    }

    /// The number of a form with its key, for one more brick.
    pub(super) fn form(&mut self, form: &Arc<Form>, key: Key) -> u32 {
        let (number, is_new) = self.form_numbers.take(key);
        if is_new {
            set_numbered(&mut self.forms, number, form);
            self.new_forms.push((number, Arc::clone(form)));
        }
        number
    }

    /// Ends the use of a form by a brick.
    pub(super) fn release_form(&mut self, number: u32) {
        self.form_numbers.release(number);
    }

    /// Adds a brick that had this form before.
    pub(super) fn take_form_back(&mut self, number: u32) {
        let key = self.forms[number as usize].key();
        self.form_numbers.take_back(number, key);
    }

    /// Returns to the first `count` forms, some of which were others since.
    pub(super) fn restore_forms(&mut self, count: usize, changed: &Numbered<Arc<Form>>) {
        trim(&mut self.forms, count);
        self.form_numbers.truncate(count);
        for (number, form) in changed {
            set_numbered(&mut self.forms, *number, form);
        }
    }

    /// The forms since the last change, sorted by their numbers.
    pub(super) fn take_new_forms(&mut self) -> Numbered<Arc<Form>> {
        self.new_forms.sort_unstable_by_key(|form| form.0);
        std::mem::take(&mut self.new_forms)
    }

    /// Numbers of the matrices of elements of a level, and the new ones; elements with equal parts share one.
    pub(super) fn matrices<'a>(
        &mut self,
        l: usize,
        parts: impl Iterator<Item = &'a Parts>,
        per_spacing: f32,
    ) -> (Vec<u32>, Numbered<Stiffness>) {
        if self.levels.len() == l {
            self.levels.push(LevelKinds::default());
        }
        let (finer, coarser) = self.levels.split_at_mut(l);
        let finer = finer.last();
        let LevelKinds { matrices, numbers } = &mut coarser[0];
        let mut new: Vec<(u32, &Parts)> = Vec::new();
        let number = |list| {
            let (number, is_new) = numbers.take(key_of(list));
            new.extend(is_new.then_some((number, list)));
            number
        };
        let index = parts.map(number).collect();
        let forms = &self.forms;
        let arch = Arch::new();
        let made: Numbered<Stiffness> = new
            .par_iter()
            .map(|&(number, list)| {
                let stiffness = arch.dispatch(StiffnessOf {
                    list,
                    forms,
                    finer,
                    per_spacing,
                });
                (number, stiffness)
            })
            .collect();
        // New numbers beyond the known ones ascend.
        for (number, matrix) in &made {
            set_numbered(matrices, *number, matrix);
        }
        (index, made)
    }
}

/// Key of these parts.
fn key_of(parts: &Parts) -> Key {
    parts.iter().fold(0, |key, &(part, how)| {
        let mut bytes = [0; size_of::<Key>() + 2 * size_of::<u32>()];
        bytes[..16].copy_from_slice(&key.to_le_bytes());
        bytes[16..20].copy_from_slice(&part.to_le_bytes());
        bytes[20..].copy_from_slice(&how.to_le_bytes());
        xxh3_128(&bytes)
    })
}

/// The stiffness of an element with these parts.
struct StiffnessOf<'a> {
    list: &'a Parts,
    forms: &'a [Arc<Form>],
    finer: Option<&'a LevelKinds>,
    per_spacing: f32,
}

impl WithSimd for StiffnessOf<'_> {
    type Output = Stiffness;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Stiffness {
        let mut sum = Sum::new();
        // SIMD code stays out of closures: they are compiled without the vectors of this machine.
        match self.finer {
            None => self.add_bricks(simd, &mut sum),
            Some(level) => self.add_children(simd, &mut sum, level),
        }
        let first = self.list[0].0;
        let alike = self.list.iter().all(|part| part.0 == first)
            && match self.finer {
                None => self.forms[first as usize].is_regular(self.per_spacing),
                Some(level) => level.matrices[first as usize].matrix.even(),
            };
        let (is_cut, is_free) = match self.finer {
            None => {
                let marks = self.list.iter().fold(0, |all, part| all | part.1);
                (marks & CUT != 0, marks & NODES == 0)
            }
            Some(level) => {
                let mut children = self.list.iter().map(|c| &level.matrices[c.0 as usize]);
                let is_cut = children.clone().any(|child| child.condensed.is_none());
                (is_cut, children.all(|child| child.is_free))
            }
        };
        let mut condensed = None;
        if !is_cut {
            let k = match self.finer {
                None => self.condensed_bricks(simd),
                Some(level) => self.condensed_children(simd, level),
            };
            // The smoother does not use it, and needs no bound.
            condensed = Some(Matrix::new(&k, [[0.0; 6]; 8], alike));
        }
        Stiffness {
            matrix: sum.finish(simd, alike),
            condensed,
            is_free,
        }
    }
}

impl StiffnessOf<'_> {
    #[inline(always)]
    fn add_bricks<S: Simd>(&self, simd: S, sum: &mut Sum) {
        for &(form, marks) in self.list {
            let form = &self.forms[form as usize];
            sum.add_brick(simd, form, marks & NODES, self.per_spacing);
        }
    }

    #[inline(always)]
    fn add_children<S: Simd>(&self, simd: S, sum: &mut Sum, level: &LevelKinds) {
        for &(child, octant) in self.list {
            let child = &level.matrices[child as usize];
            sum.add_child(simd, &child.matrix, octant as usize);
        }
    }

    #[inline(always)]
    fn condensed_bricks<S: Simd>(&self, simd: S) -> Dense {
        let mut nodal = NodalStiffness::new();
        for &(form, marks) in self.list {
            let form = &self.forms[form as usize];
            nodal.add_brick(form, marks & NODES, self.per_spacing);
        }
        nodal.condensed(simd, SOFTER)
    }

    #[inline(always)]
    fn condensed_children<S: Simd>(&self, simd: S, level: &LevelKinds) -> Dense {
        let mut nodal = NodalStiffness::new();
        for &(child, octant) in self.list {
            if let Some(k) = &level.matrices[child as usize].condensed {
                nodal.add_child(&k.dense(), octant as usize);
            }
        }
        nodal.condensed(simd, 1.0)
    }
}

/// Size of the numbers that a key covers.
const KEY_BYTES: usize = size_of::<f32>() * (3 * LOCALS + DIRECTIONS * SPAN + 3 * LANES + 3);

impl Form {
    /// Equal keys mean equal forms.
    pub(super) fn key(&self) -> Key {
        let arrays = self.rest.iter().map(|axis| &axis[..LOCALS]);
        let arrays = arrays.chain(self.stiffness.iter().map(|row| &row[..]));
        let curve = [
            self.curve.stiffening,
            self.curve.limits[0],
            self.curve.limits[1],
        ];
        let arrays = arrays.chain([&self.bulk[..], &self.per_volume, &curve, &self.corner]);
        let mut bytes = [0; KEY_BYTES];
        let mut left = &mut bytes[..];
        for values in arrays {
            let (now, later) = left.split_at_mut(size_of_val(values));
            for (to, v) in now.chunks_exact_mut(size_of::<f32>()).zip(values) {
                to.copy_from_slice(&v.to_bits().to_le_bytes());
            }
            left = later;
        }
        xxh3_128(&bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn number_is_given_again_only_after_its_last_use() {
        let key = |name: char| Key::from(u32::from(name));
        let mut numbers = Numbers::default();
        assert_eq!(numbers.take(key('a')), (0, true));
        assert_eq!(numbers.take(key('b')), (1, true));
        assert_eq!(numbers.take(key('a')), (0, false));
        numbers.release(0);
        assert_eq!(numbers.take(key('c')), (2, true));
        numbers.release(0);
        assert_eq!(numbers.take(key('d')), (0, true));
        assert_eq!(numbers.take(key('a')), (3, true));
        let mut same = Numbers::used(
            4,
            [(2, 'c'), (3, 'a'), (3, 'a')]
                .map(|(n, k)| (n, key(k)))
                .into_iter(),
        );
        assert_eq!(same.take(key('c')), (2, false));
        assert_eq!(same.take(key('e')).0 + same.take(key('f')).0, 1);
        assert_eq!(same.take(key('g')), (4, true));
    }
}
