//! Matrix products beside a CBLAS library, turn by turn in one process.
//!
//! `cargo bench --bench products -- [--blas PATH] [--threads N] [--rounds N] [NAME...]`
//!
//! PATH is a shared library with `cblas_sgemm` (MKL's `libmkl_rt.so`, OpenBLAS, also that inside numpy); it is loaded at run time. Set its
//! number of threads by its own environment variables too (`MKL_NUM_THREADS`, `OPENBLAS_NUM_THREADS`) if it does not take it.
//! Rows are the shapes of models: `y` forward, `dx` and `dw` backward.

use clap::Parser;
use reviv::engine::ops::gemm::{Matrix, Threads, gemm_into};
use std::hint::black_box;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// How long to wait before a turn of ours: threads of OpenMP go on spinning for 200 ms after a product, on the cores that are measured.
const SPIN: Duration = Duration::from_millis(300);

/// Measures products.
#[derive(Debug, Parser)]
#[command(name = "products")]
struct Arguments {
    /// Rows whose name holds one of these; all if nothing is named.
    names: Vec<String>,
    /// A CBLAS library to measure beside.
    #[arg(long, value_name = "PATH")]
    blas: Option<PathBuf>,
    /// Threads; one and as many as there are cores if not given.
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// How often each side has its turn.
    #[arg(long, value_name = "N", default_value = "5")]
    rounds: usize,
    #[arg(long, hide = true)]
    #[allow(dead_code)] // Cargo passes it to every bench.
    bench: bool,
}

/// How the operands of `c = a b` lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// `x W^T`: `b` is transposed.
    Forward,
    /// `dy W`: neither is.
    Inputs,
    /// `dy^T x`: `a` is.
    Weights,
}

/// A product of a model.
#[derive(Debug, Clone)]
struct Row {
    name: String,
    kind: Kind,
    rows: usize,
    columns: usize,
    inner: usize,
}

/// The three products of a linear layer on `tokens` tokens.
fn layer(name: &str, tokens: usize, inputs: usize, outputs: usize) -> [Row; 3] {
    let row = |what: &str, kind, rows, columns, inner| Row {
        name: format!("{name} {what}"),
        kind,
        rows,
        columns,
        inner,
    };
    [
        row("y", Kind::Forward, tokens, outputs, inputs),
        row("dx", Kind::Inputs, tokens, inputs, outputs),
        row("dw", Kind::Weights, outputs, inputs, tokens),
    ]
}

fn rows() -> Vec<Row> {
    let attention = |name: &str, queries, keys, head| {
        [
            (Kind::Forward, "scores", queries, keys, head),
            (Kind::Inputs, "mixed", queries, head, keys),
            (Kind::Weights, "dk", keys, head, queries),
        ]
        .map(|(kind, what, rows, columns, inner)| Row {
            name: format!("{name} attention {what}"),
            kind,
            rows,
            columns,
            inner,
        })
    };
    [
        layer("tokenizer qkv", 2760, 768, 2304),
        layer("tokenizer fc1", 2760, 768, 3072),
        layer("tokenizer fc2", 2760, 3072, 768),
        layer("laptop qkv", 1680, 144, 432),
        layer("laptop fc1", 1680, 144, 384),
        layer("laptop fc2", 1680, 384, 144),
        layer("laptop head", 840, 144, 256),
        attention("laptop", 128, 128, 24),
        layer("tiny qkv", 2048, 384, 1152),
        layer("tiny proj", 2048, 384, 384),
        layer("tiny fc1", 2048, 384, 1024),
        layer("tiny fc2", 2048, 1024, 384),
        layer("tiny head", 512, 384, 64_000),
        attention("tiny", 128, 256, 64),
        layer("base qkv", 1024, 768, 2304),
        layer("base fc1", 1024, 768, 2048),
        layer("base fc2", 1024, 2048, 768),
        layer("base head", 480, 768, 64_000),
        attention("base", 128, 768, 64),
        layer("one token", 1, 384, 384),
        layer("few tokens", 30, 384, 1152),
    ]
    .into_iter()
    .flatten()
    .collect()
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let blas = match arguments.blas.as_deref().map(blas::Blas::open).transpose() {
        Ok(blas) => blas,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::FAILURE;
        }
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut counts = arguments
        .threads
        .map_or_else(|| vec![1, cores], |n| vec![n]);
    counts.dedup();
    for threads in counts {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads can be started");
        if let Some(blas) = &blas {
            blas.threads(threads);
        }
        println!("\n{threads} threads, GF/s\n");
        println!("| product | m | n | k | reviv | CBLAS | ratio |\n|---|--:|--:|--:|--:|--:|--:|");
        let (mut logs, mut lowest) = (Vec::new(), f64::INFINITY);
        for row in rows() {
            let named = arguments.names.iter().any(|name| row.name.contains(name));
            if !(named || arguments.names.is_empty()) {
                continue;
            }
            let (ours, theirs) = pool.install(|| measure(&row, blas.as_ref(), arguments.rounds));
            let Row {
                name,
                rows,
                columns,
                inner,
                ..
            } = &row;
            print!("| {name} | {rows} | {columns} | {inner} | {ours:.1} | ");
            match theirs {
                Some(theirs) => {
                    println!("{theirs:.1} | {:.2} |", ours / theirs);
                    logs.push((ours / theirs).ln());
                    if (*rows).min(*columns).min(*inner) >= 256 {
                        lowest = lowest.min(ours / theirs);
                    }
                }
                None => println!("- | - |"),
            }
        }
        if !logs.is_empty() {
            let mean = (logs.iter().sum::<f64>() / logs.len() as f64).exp();
            println!(
                "\nGeometric mean of the ratios {mean:.2}; the lowest from 256 up {lowest:.2}."
            );
        }
    }
    ExitCode::SUCCESS
}

/// Rates of both sides in GF/s: medians of turns.
fn measure(row: &Row, blas: Option<&blas::Blas>, rounds: usize) -> (f64, Option<f64>) {
    let (m, n, k) = (row.rows, row.columns, row.inner);
    let wave = |length: usize| -> Vec<f32> { (0..length).map(|i| (i as f32).sin()).collect() };
    let (a, b) = (wave(m * k), wave(k * n));
    let (mut c, mut d) = (vec![0.0; m * n], vec![0.0; m * n]);
    let left = match row.kind {
        Kind::Weights => Matrix::rows(&a, k, m).transposed(),
        _ => Matrix::rows(&a, m, k),
    };
    let right = match row.kind {
        Kind::Forward => Matrix::rows(&b, n, k).transposed(),
        _ => Matrix::rows(&b, k, n),
    };
    let work = 2.0 * m as f64 * n as f64 * k as f64;
    let repeats = ((1e9 / work).ceil() as usize).clamp(1, 2000);
    let timed = |run: &mut dyn FnMut()| {
        let start = Instant::now();
        for _ in 0..repeats {
            run();
        }
        work * repeats as f64 / start.elapsed().as_secs_f64() / 1e9
    };
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    for round in 0..=rounds {
        if blas.is_some() {
            std::thread::sleep(SPIN);
        }
        let own = timed(&mut || {
            gemm_into(&mut c, n, left, right, 1.0, false, Threads::All);
            black_box(&c);
        });
        let other = blas.map(|blas| timed(&mut || blas.product(row, &a, &b, black_box(&mut d))));
        // The first turn warms up.
        if round > 0 {
            ours.push(own);
            theirs.extend(other);
        }
    }
    if blas.is_some() {
        let off = c
            .iter()
            .zip(&d)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(off < 1e-3 * k as f32, "both sides compute the same: {off}");
    }
    (median(ours), (!theirs.is_empty()).then(|| median(theirs)))
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// A CBLAS library, loaded at run time.
mod blas {
    #![allow(unsafe_code)] // A library that is not there at compile time.

    use super::{Kind, Row};
    use std::ffi::{CString, c_char, c_int, c_void};
    use std::os::unix::ffi::OsStrExt;
    use std::path::Path;

    unsafe extern "C" {
        fn dlopen(path: *const c_char, flags: c_int) -> *mut c_void;
        fn dlsym(library: *mut c_void, name: *const c_char) -> *mut c_void;
    }

    /// `cblas_sgemm` with integers of `I`.
    type Sgemm<I> = unsafe extern "C" fn(
        c_int,
        c_int,
        c_int,
        I,
        I,
        I,
        f32,
        *const f32,
        I,
        *const f32,
        I,
        f32,
        *mut f32,
        I,
    );

    /// Its product, with the integers it takes.
    enum Function {
        Short(Sgemm<i32>),
        Long(Sgemm<i64>),
    }

    pub struct Blas {
        function: Function,
        set_threads: Option<unsafe extern "C" fn(c_int)>,
    }

    impl Blas {
        pub fn open(path: &Path) -> Result<Self, String> {
            let name =
                CString::new(path.as_os_str().as_bytes()).map_err(|error| error.to_string())?;
            // SAFETY: a string with its end; the library stays loaded. RTLD_NOW and RTLD_GLOBAL.
            let library = unsafe { dlopen(name.as_ptr(), 2 | 0x100) };
            if library.is_null() {
                return Err(format!("{} cannot be loaded", path.display()));
            }
            let find = |name: &str| -> Option<*mut c_void> {
                let name = CString::new(name).ok()?;
                // SAFETY: the library is loaded.
                let found = unsafe { dlsym(library, name.as_ptr()) };
                (!found.is_null()).then_some(found)
            };
            // SAFETY: these names have these types in every CBLAS; those with 64 take long integers.
            let function = unsafe {
                if let Some(found) = find("scipy_cblas_sgemm64_").or_else(|| find("cblas_sgemm64_"))
                {
                    Function::Long(std::mem::transmute::<*mut c_void, Sgemm<i64>>(found))
                } else if let Some(found) = find("cblas_sgemm") {
                    Function::Short(std::mem::transmute::<*mut c_void, Sgemm<i32>>(found))
                } else {
                    return Err(format!("{} has no `cblas_sgemm`", path.display()));
                }
            };
            let set_threads = [
                "MKL_Set_Num_Threads",
                "openblas_set_num_threads",
                "scipy_openblas_set_num_threads64_",
            ];
            let set_threads = set_threads.into_iter().find_map(find);
            // SAFETY: these functions take one integer.
            let set_threads = set_threads.map(|found| unsafe {
                std::mem::transmute::<*mut c_void, unsafe extern "C" fn(c_int)>(found)
            });
            Ok(Self {
                function,
                set_threads,
            })
        }

        pub fn threads(&self, count: usize) {
            if let Some(set) = self.set_threads {
                // SAFETY: any number is taken.
                unsafe { set(count as c_int) }
            }
        }

        pub fn product(&self, row: &Row, a: &[f32], b: &[f32], c: &mut [f32]) {
            let (m, n, k) = (row.rows, row.columns, row.inner);
            assert_eq!((a.len(), b.len(), c.len()), (m * k, k * n, m * n));
            let (plain, turned) = (111, 112);
            let (turn_a, a_row) = match row.kind {
                Kind::Weights => (turned, m),
                _ => (plain, k),
            };
            let (turn_b, b_row) = match row.kind {
                Kind::Forward => (turned, k),
                _ => (plain, n),
            };
            let (a, b, c) = (a.as_ptr(), b.as_ptr(), c.as_mut_ptr());
            // SAFETY: row-major matrices that lie in their slices, as asserted.
            unsafe {
                match self.function {
                    Function::Short(sgemm) => {
                        let [m, n, k, a_row, b_row] = [m, n, k, a_row, b_row].map(|x| x as i32);
                        sgemm(
                            101, turn_a, turn_b, m, n, k, 1.0, a, a_row, b, b_row, 0.0, c, n,
                        );
                    }
                    Function::Long(sgemm) => {
                        let [m, n, k, a_row, b_row] = [m, n, k, a_row, b_row].map(|x| x as i64);
                        sgemm(
                            101, turn_a, turn_b, m, n, k, 1.0, a, a_row, b, b_row, 0.0, c, n,
                        );
                    }
                }
            }
        }
    }
}
