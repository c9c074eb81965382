//! Products of rows with a small matrix, both in 16 bits: the two matrix products of attention.
//!
//! The multiply-add instruction takes neighbors two by two: `(x_2p, x_2p+1) · (m_2p, m_2p+1)` for eight columns at
//! once. So the matrix is packed in tiles of sixteen columns, pair after pair of its depth; a pair of a row is
//! broadcast.

use super::{Avx2, Avx512Vnni};
use core::arch::x86_64::{__m256i, _mm256_add_epi32, _mm256_madd_epi16, _mm256_set1_epi32, _mm256_setzero_si256};

/// Rows that are multiplied at once: each tile is loaded once for all of them.
pub(super) const ROWS: usize = 4;

/// Columns of a tile: two vectors of sums.
pub(super) const COLUMNS: usize = 16;

/// Tiles that a [`Matrix`] holds.
pub(super) const TILES: usize = 512;

/// Two neighbors in the depth of a product.
pub(super) type Pair = [i16; 2];

/// A matrix of `2·pairs` rows and any number of columns, zero where nothing was packed.
#[repr(align(64))]
pub(super) struct Matrix {
    /// `[column / COLUMNS][pair][column % COLUMNS]`.
    tiles: [[Pair; COLUMNS]; TILES],
    pairs: usize,
}

impl Matrix {
    /// Whether a matrix of this depth and so many columns fits.
    pub(super) fn holds(depth: usize, columns: usize) -> bool {
        depth.div_ceil(2) * columns.div_ceil(COLUMNS) <= TILES
    }

    /// Zero.
    #[inline(always)]
    pub(super) fn new(depth: usize) -> Self {
        Self { tiles: [[[0; 2]; COLUMNS]; TILES], pairs: depth.div_ceil(2) }
    }

    /// Packs a column.
    #[inline(always)]
    pub(super) fn set_column(&mut self, column: usize, codes: &[i8]) {
        let tiles = self.tiles.get_mut(column / COLUMNS * self.pairs..).unwrap_or_default();
        for (tile, codes) in tiles.iter_mut().zip(codes.chunks(2)) {
            tile[column % COLUMNS] = pair(codes);
        }
    }

    /// Packs rows `2·pair` and `2·pair + 1`; the second is empty behind the last row of an odd depth.
    #[inline(always)]
    pub(super) fn set_rows(&mut self, pair: usize, first: &[i8], second: &[i8]) {
        let tiles = self.tiles.get_mut(pair..).unwrap_or_default().iter_mut().step_by(self.pairs.max(1));
        let seconds = second.chunks(COLUMNS).chain(core::iter::repeat(&[][..]));
        for ((tile, first), second) in tiles.zip(first.chunks(COLUMNS)).zip(seconds) {
            for (pair, code) in tile.iter_mut().zip(first) {
                pair[0] = (*code).into();
            }
            for (pair, code) in tile.iter_mut().zip(second) {
                pair[1] = (*code).into();
            }
        }
    }

    /// The product of [`ROWS`] rows of `depth` (even, zero behind the last) with the columns: `sums[row][column]`,
    /// wrapping.
    #[inline(always)]
    pub(super) fn multiply<const N: usize>(
        &self,
        product: impl PairProduct,
        rows: &[[i16; N]; ROWS],
        columns: usize,
        sums: &mut [[i32; N]; ROWS],
    ) {
        let rows = rows.each_ref().map(|row| row.as_chunks().0.get(..self.pairs).unwrap_or_default());
        let tiles = self.tiles.chunks_exact(self.pairs.max(1));
        for (tiles, first) in tiles.zip((0..columns).step_by(COLUMNS)) {
            for (sums, tile) in sums.iter_mut().zip(product.tile(tiles, rows)) {
                for (sum, value) in sums.iter_mut().skip(first).zip(tile) {
                    *sum = value;
                }
            }
        }
    }
}

/// One or two codes, widened.
#[inline(always)]
fn pair(codes: &[i8]) -> Pair {
    match codes {
        [first, second, ..] => [(*first).into(), (*second).into()],
        [first] => [(*first).into(), 0],
        [] => [0; 2],
    }
}

/// A backend that multiplies and adds pairs.
pub(super) trait PairProduct: Copy {
    /// `Σ_p row_p · column_p` of each row with the [`COLUMNS`] columns of consecutive tiles, wrapping.
    fn tile(self, tiles: &[[Pair; COLUMNS]], rows: [&[Pair]; ROWS]) -> [[i32; COLUMNS]; ROWS];
}

impl PairProduct for Avx2 {
    #[inline(always)]
    fn tile(self, tiles: &[[Pair; COLUMNS]], rows: [&[Pair]; ROWS]) -> [[i32; COLUMNS]; ROWS] {
        // SAFETY: the token proves that this machine has AVX2.
        unsafe { tile_avx2(tiles, rows) }
    }
}

impl PairProduct for Avx512Vnni {
    #[inline(always)]
    fn tile(self, tiles: &[[Pair; COLUMNS]], rows: [&[Pair]; ROWS]) -> [[i32; COLUMNS]; ROWS] {
        // SAFETY: the token proves that this machine has AVX-512 F, VL and VNNI.
        unsafe { tile_avx512(tiles, rows) }
    }
}

/// With AVX-512, 32 registers and a multiply-add that accumulates, which the compiler forms of the two instructions.
#[target_feature(enable = "avx512f,avx512vl,avx512vnni")]
#[inline]
fn tile_avx512(tiles: &[[Pair; COLUMNS]], rows: [&[Pair]; ROWS]) -> [[i32; COLUMNS]; ROWS] {
    tile_avx2(tiles, rows)
}

#[target_feature(enable = "avx2")]
#[inline]
fn tile_avx2(tiles: &[[Pair; COLUMNS]], rows: [&[Pair]; ROWS]) -> [[i32; COLUMNS]; ROWS] {
    let mut sums = [[_mm256_setzero_si256(); 2]; ROWS];
    let [first, second, third, fourth] = rows;
    for ((((tile, first), second), third), fourth) in tiles.iter().zip(first).zip(second).zip(third).zip(fourth) {
        let columns: [__m256i; 2] = bytemuck::cast(*tile);
        for (sums, pair) in sums.iter_mut().zip([first, second, third, fourth]) {
            let pair = _mm256_set1_epi32(bytemuck::cast(*pair));
            for (sum, columns) in sums.iter_mut().zip(columns) {
                *sum = _mm256_add_epi32(*sum, _mm256_madd_epi16(columns, pair));
            }
        }
    }
    bytemuck::cast(sums)
}
