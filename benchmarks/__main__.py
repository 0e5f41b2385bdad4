import sys

from jaxfilters.benchmarks.harness import main

sys.exit(main())
