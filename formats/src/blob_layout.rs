//! Where everything stands in a `.sfw` file: the numbers of `docs/blob-format.md`, once.
//!
//! ```text
//! header 256 B | metadata | tensor records 96 B each | names | zeros to 4096 | tensors, each at a multiple of 64
//! ```
//!
//! Little-endian. No gaps but zero padding, no overlaps, nothing after the last tensor.

#[cfg(target_endian = "big")]
compile_error!("blobs are little-endian and used in place: a big-endian machine would need a converting loader");

/// A field of a fixed-width structure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field {
    /// Name in the specification.
    pub name: &'static str,
    /// Bytes from the start of the structure.
    pub offset: usize,
    /// Length in bytes.
    pub size: usize,
}

impl Field {
    const fn new(name: &'static str, offset: usize, size: usize) -> Field {
        Field { name, offset, size }
    }

    /// Its bytes.
    pub fn of<'a>(&self, structure: &'a [u8]) -> &'a [u8] {
        &structure[self.offset..self.offset + self.size]
    }

    /// As an unsigned number of up to eight bytes.
    pub fn number(&self, structure: &[u8]) -> u64 {
        assert!(self.size <= 8, "{} is not a number", self.name);
        let mut bytes = [0; 8];
        bytes[..self.size].copy_from_slice(self.of(structure));
        u64::from_le_bytes(bytes)
    }

    /// Stores a number; it must fit.
    pub fn put_number(&self, structure: &mut [u8], value: u64) {
        assert!(self.size == 8 || value < 1 << (8 * self.size), "{} = {value} does not fit", self.name);
        structure[self.offset..self.offset + self.size].copy_from_slice(&value.to_le_bytes()[..self.size]);
    }

    /// Stores bytes of exactly its length.
    pub fn put(&self, structure: &mut [u8], bytes: &[u8]) {
        structure[self.offset..self.offset + self.size].copy_from_slice(bytes);
    }
}

/// First bytes of every blob. The high bit, CR LF, Ctrl-Z and LF each catch one kind of damage by
/// transfers that take the file for text.
pub const MAGIC_BYTES: [u8; 8] = [0x89, b'S', b'F', b'W', 0x0d, 0x0a, 0x1a, 0x0a];
/// Reads as 0x01020304 only in the right byte order.
pub const ENDIAN_WORD: u32 = 0x0102_0304;
/// Format version written; a reader takes every minor of this major.
pub const VERSION: (u16, u16) = (1, 1);
/// Architecture id of the StreetForward network.
pub const ARCHITECTURE_STREETFORWARD: u32 = 1;
/// Digest algorithm id of SHA-256.
pub const DIGEST_SHA256: u32 = 1;
/// Bytes of the header.
pub const HEADER: usize = 256;
/// Bytes of a tensor record.
pub const RECORD: usize = 96;
/// Alignment of the data section: a page.
pub const DATA_ALIGN: u64 = 4096;
/// Alignment of a tensor: a cache line.
pub const TENSOR_ALIGN: u64 = 64;
/// Most tensors.
pub const MAX_TENSORS: u64 = 8192;
/// Longest tensor name in bytes.
pub const MAX_NAME: usize = 128;
/// Most dimensions.
pub const MAX_RANK: usize = 5;
/// Largest dimension.
pub const MAX_DIM: u32 = 1 << 24;
/// Largest header section: everything before the data.
pub const MAX_HEAD: u64 = 1 << 20;
/// Smallest file.
pub const MIN_FILE: u64 = 4096;
/// Largest file.
pub const MAX_FILE: u64 = 16 << 30;

/// Fields of the header.
pub mod header {
    use super::Field;

    /// [`super::MAGIC_BYTES`].
    pub const MAGIC: Field = Field::new("magic", 0, 8);
    /// [`super::ENDIAN_WORD`].
    pub const ENDIAN: Field = Field::new("endianness", 8, 4);
    /// Structure version.
    pub const MAJOR: Field = Field::new("major", 12, 2);
    /// Compatible additions.
    pub const MINOR: Field = Field::new("minor", 14, 2);
    /// Bytes of this header, [`super::HEADER`].
    pub const HEADER_LENGTH: Field = Field::new("header_length", 16, 4);
    /// Which network.
    pub const ARCHITECTURE: Field = Field::new("architecture", 20, 4);
    /// Exact length of the file.
    pub const FILE_LENGTH: Field = Field::new("file_length", 24, 8);
    /// Bits a reader must know to read the file.
    pub const REQUIRED: Field = Field::new("required_features", 32, 8);
    /// Bits a reader may ignore.
    pub const OPTIONAL: Field = Field::new("optional_features", 40, 8);
    /// Digest algorithm.
    pub const DIGEST_KIND: Field = Field::new("digest_algorithm", 48, 4);
    /// Number of metadata entries.
    pub const META_COUNT: Field = Field::new("metadata_count", 52, 4);
    /// Start of the metadata.
    pub const META_OFFSET: Field = Field::new("metadata_offset", 56, 8);
    /// Its length.
    pub const META_LENGTH: Field = Field::new("metadata_length", 64, 8);
    /// Number of tensors.
    pub const TENSOR_COUNT: Field = Field::new("tensor_count", 72, 8);
    /// Start of the tensor records.
    pub const TABLE_OFFSET: Field = Field::new("table_offset", 80, 8);
    /// Their length.
    pub const TABLE_LENGTH: Field = Field::new("table_length", 88, 8);
    /// Start of the names.
    pub const NAMES_OFFSET: Field = Field::new("names_offset", 96, 8);
    /// Their length.
    pub const NAMES_LENGTH: Field = Field::new("names_length", 104, 8);
    /// Start of the data section.
    pub const DATA_OFFSET: Field = Field::new("data_offset", 112, 8);
    /// Its length.
    pub const DATA_LENGTH: Field = Field::new("data_length", 120, 8);
    /// Zero.
    pub const RESERVED: Field = Field::new("reserved", 128, 64);
    /// SHA-256 of all tensor digests in order.
    pub const TENSOR_ROOT: Field = Field::new("tensor_root", 192, 32);
    /// SHA-256 of everything before the data section, this field read as zeros.
    pub const HEADER_DIGEST: Field = Field::new("header_digest", 224, 32);

    /// All of them, in order.
    pub const ALL: [Field; 23] = [
        MAGIC,
        ENDIAN,
        MAJOR,
        MINOR,
        HEADER_LENGTH,
        ARCHITECTURE,
        FILE_LENGTH,
        REQUIRED,
        OPTIONAL,
        DIGEST_KIND,
        META_COUNT,
        META_OFFSET,
        META_LENGTH,
        TENSOR_COUNT,
        TABLE_OFFSET,
        TABLE_LENGTH,
        NAMES_OFFSET,
        NAMES_LENGTH,
        DATA_OFFSET,
        DATA_LENGTH,
        RESERVED,
        TENSOR_ROOT,
        HEADER_DIGEST,
    ];
}

/// Fields of a tensor record.
pub mod record {
    use super::Field;

    /// Start of the name in the names section.
    pub const NAME_OFFSET: Field = Field::new("name_offset", 0, 4);
    /// Its length.
    pub const NAME_LENGTH: Field = Field::new("name_length", 4, 2);
    /// [`super::Dtype`].
    pub const DTYPE: Field = Field::new("dtype", 6, 1);
    /// [`super::Layout`].
    pub const LAYOUT: Field = Field::new("layout", 7, 1);
    /// Number of dimensions.
    pub const RANK: Field = Field::new("rank", 8, 4);
    /// Five u32, unused ones zero.
    pub const DIMS: Field = Field::new("dims", 12, 20);
    /// Start of the values in the file.
    pub const OFFSET: Field = Field::new("offset", 32, 8);
    /// Their length in bytes.
    pub const LENGTH: Field = Field::new("length", 40, 8);
    /// Their SHA-256.
    pub const DIGEST: Field = Field::new("digest", 48, 32);
    /// Values of a block of the rotation of an int8 matrix's inputs; 0 where they are not rotated.
    pub const ROTATION: Field = Field::new("rotation", 80, 4);
    /// Zero.
    pub const RESERVED: Field = Field::new("reserved", 84, 12);

    /// All of them, in order.
    pub const ALL: [Field; 11] =
        [NAME_OFFSET, NAME_LENGTH, DTYPE, LAYOUT, RANK, DIMS, OFFSET, LENGTH, DIGEST, ROTATION, RESERVED];
}

/// Type of stored values.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Dtype {
    /// IEEE 754 binary32.
    F32 = 1,
    /// IEEE 754 binary16; arithmetic stays f32.
    F16 = 2,
    /// Signed bytes in [-127, 127] with one f32 scale per output; matrices only.
    Int8 = 3,
}

impl Dtype {
    /// All types.
    pub const ALL: [Dtype; 3] = [Dtype::F32, Dtype::F16, Dtype::Int8];

    /// Of a code.
    pub fn from_code(code: u8) -> Option<Dtype> {
        Dtype::ALL.into_iter().find(|d| *d as u8 == code)
    }

    /// Bytes of a value.
    pub fn size(self) -> usize {
        match self {
            Dtype::F32 => 4,
            Dtype::F16 => 2,
            Dtype::Int8 => 1,
        }
    }

    /// `f32`, `f16` or `int8`.
    pub fn name(self) -> &'static str {
        match self {
            Dtype::F32 => "f32",
            Dtype::F16 => "f16",
            Dtype::Int8 => "int8",
        }
    }
}

/// Order of stored values.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Layout {
    /// As in the checkpoint, last dimension fastest.
    RowMajor = 0,
    /// Panels of 16 outputs, see [`crate::panel`].
    K1N16 = 1,
    /// Panels of 16 outputs by four inputs, then scales, sums and signs, see [`crate::panel_s8`].
    K4N16 = 2,
}

impl Layout {
    /// All layouts.
    pub const ALL: [Layout; 3] = [Layout::RowMajor, Layout::K1N16, Layout::K4N16];

    /// Of a code.
    pub fn from_code(code: u8) -> Option<Layout> {
        Layout::ALL.into_iter().find(|l| *l as u8 == code)
    }

    /// The layout in which matrices of a type are stored.
    pub fn of_matrix(dtype: Dtype) -> Layout {
        if dtype == Dtype::Int8 { Layout::K4N16 } else { Layout::K1N16 }
    }

    /// `RowMajor`, `K1N16` or `K4N16`.
    pub fn name(self) -> &'static str {
        match self {
            Layout::RowMajor => "RowMajor",
            Layout::K1N16 => "K1N16",
            Layout::K4N16 => "K4N16",
        }
    }
}

/// `value` rounded up to a multiple of `to`; `None` past the end of u64.
pub(crate) fn align(value: u64, to: u64) -> Option<u64> {
    value.checked_next_multiple_of(to)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_tile_their_structures() {
        for (fields, size) in [(&header::ALL[..], HEADER), (&record::ALL[..], RECORD)] {
            let mut end = 0;
            for f in fields {
                assert_eq!(f.offset, end, "{}", f.name);
                end += f.size;
            }
            assert_eq!(end, size);
        }
    }
}
