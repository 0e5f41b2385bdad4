from . import assignment as assignment
from . import diffusion as diffusion
from . import incremental_pca as incremental_pca
from . import lie as lie
from . import linalg as linalg
from . import multilinear as multilinear
from . import tensor_completion as tensor_completion
