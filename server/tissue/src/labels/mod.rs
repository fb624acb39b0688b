//! Label volumes: images in which every voxel holds the number of the tissue it belongs to.
//!
//! [`LabelVolume::read`] brings NIfTI-1, NRRD and (with the feature `dicom`) DICOM files into one
//! form; [`surfaces`] extracts a closed surface per region from it, without gaps or overlaps
//! between neighbours.
//!
//! # World coordinates
//!
//! There is one world: x grows to the patient's right, y to the front, z upwards (RAS, as in NIfTI),
//! in metres. NRRD files that say LPS or LAS and DICOM files, which are always LPS, are turned into
//! it. Surfaces carry no such note and are taken as they are: those of a program that writes LPS
//! (3D Slicer's default) must be exported as RAS to lie where the label volume of the same subject
//! does.
//!
//! The readers are our own: NIfTI and NRRD differ in a page of header and share the reading of the
//! samples, which stays within the memory a checked header asks for, whatever the file claims.

mod affine;
#[cfg(feature = "dicom")]
mod dicom;
mod error;
mod extract;
mod nifti;
mod nrrd;
mod samples;
mod volume;

pub use affine::Affine;
pub use error::LabelError;
pub use extract::{LabelRegion, NET_VERTICES_MAX, RegionSurface, Sides, surfaces};
pub use volume::LabelVolume;

/// Most voxels of one volume. Reason: a whole body at 0.7 mm in the slice and 2 mm along has about
/// 250 million; as labels they take half a gigabyte. At the bound the volume is refused unread.
pub const VOXELS_MAX: u64 = 1 << 28;

/// Smallest and largest length in m of the longest side of a volume. Reason: a hand feels nothing
/// in a body below 5 mm, and none is longer than 5 m; both come from metres and millimetres taken
/// for each other. Outside of it the volume is refused with what it looks like.
pub const EXTENT_RANGE_M: [f64; 2] = [5e-3, 5.0];
