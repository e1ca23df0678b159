"""More than one process, on one machine or many, through JAX's own runtime."""
import jax
def share(blocks): return blocks[jax.process_index()::jax.process_count()]
def gather_blocks(results, mine, size, runs): return results
